// A number is a vector register: a lane an environment.

#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
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

template <int N>
inline std::array<V, N> gather(const float* from, int64_t stride, const int* env) {
  std::array<V, N> out;
  for (int i = 0; i < N; ++i) out[i] = gather(from + i, stride, env);
  return out;
}

inline V3 cross(const V* a, const V* b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
          a[0] * b[1] - a[1] * b[0]};
}

// The momentum of a body with a spatial inertia that moves along m.
inline void times_inertia(const V10& inertia, const V* m, V* out) {
  const V10& a = inertia;
  const V3 tilt = cross(&a[6], m + 3), lift = cross(&a[6], m);
  out[0] = a[0] * m[0] + a[3] * m[1] + a[4] * m[2] + tilt[0];
  out[1] = a[3] * m[0] + a[1] * m[1] + a[5] * m[2] + tilt[1];
  out[2] = a[4] * m[0] + a[5] * m[1] + a[2] * m[2] + tilt[2];
  for (int k = 0; k < 3; ++k) out[3 + k] = a[9] * m[3 + k] - lift[k];
}
