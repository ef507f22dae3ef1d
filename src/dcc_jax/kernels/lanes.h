// A number is a vector register: a lane an environment.

#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

// As many as a vector register holds: wider vectors would be taken apart in memory.
#if defined(__AVX512F__)
constexpr int kLanes = 16;
#else
constexpr int kLanes = 8;
#endif

typedef float V __attribute__((vector_size(4 * kLanes)));
typedef int32_t I __attribute__((vector_size(4 * kLanes)));
typedef std::array<V, 3> V3;
typedef std::array<V, 4> V4;   // a quaternion, w first
typedef std::array<V, 6> V6;   // of a motion or a force: angular, then linear
typedef std::array<V, 9> V9;   // a matrix, row by row
typedef std::array<V, 10> V10; // spatial inertia: xx yy zz xy xz yz, mass * offset, mass

inline V all(float x) { return x - V{}; }
inline V choose(I where, V yes, V no) { return where ? yes : no; }

inline bool any(I where) {
  int32_t found = 0;
  for (int l = 0; l < kLanes; ++l) found |= where[l];
  return found != 0;
}

inline V square_root(V x) {
  V out;
  for (int l = 0; l < kLanes; ++l) out[l] = std::sqrt(x[l]);
  return out;
}

// This thread's object of what is static of a scene: made once, for as long as it is asked
// for the same scene. It keeps room, but nothing that the next call reads.
template <typename Made, typename Structure, typename Numbers>
Made& kept(const Structure& structure, const Numbers& numbers) {
  thread_local std::vector<int32_t> whole;
  thread_local std::vector<float> real;
  thread_local std::unique_ptr<Made> made;
  const auto same = [](const auto& a, const auto& b) {
    return std::equal(a.begin(), a.end(), b.begin(), b.end());
  };
  if (!made || !same(whole, structure) || !same(real, numbers)) {
    made.reset();
    whole.assign(structure.begin(), structure.end());
    real.assign(numbers.begin(), numbers.end());
    made = std::make_unique<Made>(structure, numbers);
  }
  return *made;
}

// Calls with the environments of every block, and how many they are: a last block that is
// not full has its last one several times.
template <typename F>
void for_each_block(int64_t batch, F call) {
  int env[kLanes];
  for (int64_t first = 0; first < batch; first += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, batch - first));
    for (int l = 0; l < kLanes; ++l)
      env[l] = static_cast<int>(first) + std::min(l, count - 1);
    call(env, count);
  }
}

// A value of each environment; they lie `stride` apart in memory.
inline V gather(const float* from, int64_t stride, const int* env) {
  V out;
  for (int l = 0; l < kLanes; ++l) out[l] = from[stride * env[l]];
  return out;
}

// Numbers that lie side by side, anywhere in memory.
typedef float Row __attribute__((vector_size(4 * kLanes), aligned(4), may_alias));

inline Row& row(float* at) { return *reinterpret_cast<Row*>(at); }
inline const Row& row(const float* at) { return *reinterpret_cast<const Row*>(at); }

// Of two rows of blocks of kStep numbers, the odd blocks of the first and the even ones
// of the second change places.
template <int kStep, int... L>
[[gnu::always_inline]] inline void swap_blocks(Row& a, Row& b,
                                               std::integer_sequence<int, L...>) {
#if defined(__clang__)
  const Row even = __builtin_shufflevector(a, b, (L & kStep ? kLanes + L - kStep : L)...);
  const Row odd = __builtin_shufflevector(a, b, (L & kStep ? kLanes + L : L + kStep)...);
#else
  const Row even = __builtin_shuffle(a, b, I{(L & kStep ? kLanes + L - kStep : L)...});
  const Row odd = __builtin_shuffle(a, b, I{(L & kStep ? kLanes + L : L + kStep)...});
#endif
  a = even, b = odd;
}

// A square of numbers, in place: taken one by one they would cost more than all that the
// kernels calculate.
template <int kStep = kLanes / 2>
[[gnu::always_inline]] inline void transpose(Row* square) {
  for (int i = 0; i < kLanes; ++i)
    if (!(i & kStep))
      swap_blocks<kStep>(square[i], square[i + kStep],
                         std::make_integer_sequence<int, kLanes>{});
  if constexpr (kStep > 1) transpose<kStep / 2>(square);
}

// The `size` numbers of each environment, which lie side by side in memory, a square of
// them at a time; the last square may overlap the one before.
inline void load(const float* from, int64_t size, const int* env, V* to) {
  if (size < kLanes) {
    for (int64_t i = 0; i < size; ++i) to[i] = gather(from + i, size, env);
    return;
  }
  float* lanes = reinterpret_cast<float*>(to);
  for (int64_t i = 0; i < size; i += kLanes) {
    const int64_t first = std::min(i, size - kLanes);
    Row square[kLanes];
    for (int l = 0; l < kLanes; ++l) square[l] = row(from + size * env[l] + first);
    transpose(square);
    for (int l = 0; l < kLanes; ++l) row(lanes + (first + l) * kLanes) = square[l];
  }
}

// The inverse, of the first `count` environments.
inline void store(const V* from, int64_t size, const int* env, int count, float* to) {
  if (size < kLanes) {
    for (int l = 0; l < count; ++l)
      for (int64_t i = 0; i < size; ++i) to[size * env[l] + i] = from[i][l];
    return;
  }
  const float* lanes = reinterpret_cast<const float*>(from);
  for (int64_t i = 0; i < size; i += kLanes) {
    const int64_t first = std::min(i, size - kLanes);
    Row square[kLanes];
    for (int l = 0; l < kLanes; ++l) square[l] = row(lanes + (first + l) * kLanes);
    transpose(square);
    for (int l = 0; l < count; ++l) row(to + size * env[l] + first) = square[l];
  }
}

inline V3 cross(const V* a, const V* b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
          a[0] * b[1] - a[1] * b[0]};
}

// The momentum of a body with a spatial inertia a [10] that moves along m [6].
inline void times_inertia(const V* a, const V* m, V* out) {
  const V3 tilt = cross(&a[6], m + 3), lift = cross(&a[6], m);
  out[0] = a[0] * m[0] + a[3] * m[1] + a[4] * m[2] + tilt[0];
  out[1] = a[3] * m[0] + a[1] * m[1] + a[5] * m[2] + tilt[1];
  out[2] = a[4] * m[0] + a[5] * m[1] + a[2] * m[2] + tilt[2];
  for (int k = 0; k < 3; ++k) out[3 + k] = a[9] * m[3 + k] - lift[k];
}
