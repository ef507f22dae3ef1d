// Lanes that count: stands in for the vector types of kernels/lanes.h.

#pragma once

#include <cstdint>

static uint64_t operations = 0;  // of one environment's numbers; of this file

typedef int32_t I __attribute__((vector_size(4 * kLanes)));

struct alignas(4 * kLanes) V {
  float lane[kLanes];
  float& operator[](int l) { return lane[l]; }
  float operator[](int l) const { return lane[l]; }
};

template <typename F>
inline V each(F f) {
  operations += kLanes;
  V out;
  for (int l = 0; l < kLanes; ++l) out[l] = f(l);
  return out;
}

template <typename F>
inline I compared(F f) {
  operations += kLanes;
  I out;
  for (int l = 0; l < kLanes; ++l) out[l] = f(l) ? -1 : 0;
  return out;
}

#define COUNTED(op, call, out)                                                         \
  inline out operator op(const V& a, const V& b) {                                     \
    return call([&](int l) { return a[l] op b[l]; });                                  \
  }                                                                                    \
  inline out operator op(const V& a, float b) {                                        \
    return call([&](int l) { return a[l] op b; });                                     \
  }                                                                                    \
  inline out operator op(float a, const V& b) {                                        \
    return call([&](int l) { return a op b[l]; });                                     \
  }
COUNTED(+, each, V)
COUNTED(-, each, V)
COUNTED(*, each, V)
COUNTED(/, each, V)
COUNTED(<, compared, I)
COUNTED(>, compared, I)
COUNTED(<=, compared, I)
COUNTED(>=, compared, I)
COUNTED(==, compared, I)
COUNTED(!=, compared, I)
#undef COUNTED

inline V operator-(const V& a) { return each([&](int l) { return -a[l]; }); }
template <typename T>
inline V& operator+=(V& a, const T& b) { return a = a + b; }
template <typename T>
inline V& operator-=(V& a, const T& b) { return a = a - b; }
template <typename T>
inline V& operator*=(V& a, const T& b) { return a = a * b; }
template <typename T>
inline V& operator/=(V& a, const T& b) { return a = a / b; }

inline V choose(I where, V yes, V no) {
  V out;
  for (int l = 0; l < kLanes; ++l) out[l] = where[l] ? yes[l] : no[l];
  return out;
}
