// Vectors, rotations and quaternions.

#pragma once

#include "lanes.h"

inline V3 operator+(const V3& a, const V3& b) {
  return {a[0] + b[0], a[1] + b[1], a[2] + b[2]};
}
inline V3 operator-(const V3& a, const V3& b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}
template <typename T>  // a number, or one of each environment
inline V3 operator*(T scale, const V3& a) {
  return {scale * a[0], scale * a[1], scale * a[2]};
}
inline V dot(const V3& a, const V3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline V3 cross(const V3& a, const V3& b) { return cross(a.data(), b.data()); }

inline V clamp(V x, V low, V high) {
  x = choose(x < low, low, x);
  return choose(x > high, high, x);
}
inline V sign(V x) { return choose(x < 0.0f, all(-1.0f), all(1.0f)); }

inline V3 choose(I where, const V3& yes, const V3& no) {
  return {choose(where, yes[0], no[0]), choose(where, yes[1], no[1]),
          choose(where, yes[2], no[2])};
}

// Of length one; zero stays zero.
template <size_t N>
std::array<V, N> unit(std::array<V, N> a) {
  V square{};
  for (const V& x : a) square += x * x;
  const V length = square_root(square);
  const V scale = 1.0f / choose(length > 0.0f, length, all(1.0f));
  for (V& x : a) x *= scale;
  return a;
}

template <typename T>
V3 rotate(const V9& m, const T* v) {
  V3 out;
  for (int i = 0; i < 3; ++i)
    out[i] = m[3 * i] * v[0] + m[3 * i + 1] * v[1] + m[3 * i + 2] * v[2];
  return out;
}

inline V3 rotate_back(const V9& m, const V3& v) {
  V3 out;
  for (int i = 0; i < 3; ++i) out[i] = m[i] * v[0] + m[3 + i] * v[1] + m[6 + i] * v[2];
  return out;
}
template <typename T>
V9 times(const V9& a, const T* b) {
  V9 out;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      out[3 * i + j] =
          a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  return out;
}

template <typename T>
V4 times_quat(const V4& a, const T* b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
          a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
          a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

// Of a quaternion of length one. With w^2 + x^2 - y^2 - z^2 on the diagonal its rounded
// length would scale every lever, and contact forces would be ten times less exact.
template <typename Q, typename M>
void to_matrix(const Q& q, M& m) {
  m[0] = 1.0f - 2.0f * (q[2] * q[2] + q[3] * q[3]);
  m[4] = 1.0f - 2.0f * (q[1] * q[1] + q[3] * q[3]);
  m[8] = 1.0f - 2.0f * (q[1] * q[1] + q[2] * q[2]);
  m[1] = 2.0f * (q[1] * q[2] - q[0] * q[3]);
  m[2] = 2.0f * (q[1] * q[3] + q[0] * q[2]);
  m[3] = 2.0f * (q[1] * q[2] + q[0] * q[3]);
  m[5] = 2.0f * (q[2] * q[3] - q[0] * q[1]);
  m[6] = 2.0f * (q[1] * q[3] - q[0] * q[2]);
  m[7] = 2.0f * (q[2] * q[3] + q[0] * q[1]);
}

// Sine and cosine of up to 2 rad, by those of the half: there the Taylor series are exact to
// the last digit. Of more, one by one.
inline void sine_cosine(V x, V& sine, V& cosine) {
  const V half = 0.5f * x, z = half * half;
  const V odd = z * (-1.0f / 6 + z * (1.0f / 120 + z * (-1.0f / 5040 +
                     z * (1.0f / 362880 - z * (1.0f / 39916800)))));
  const V s = half + half * odd;
  const V even = z * (-1.0f / 2 + z * (1.0f / 24 + z * (-1.0f / 720 +
                      z * (1.0f / 40320 - z * (1.0f / 3628800)))));
  sine = 2.0f * s * (1.0f + even);
  cosine = 1.0f - 2.0f * s * s;
  const I far = z > 1.0f;
  if (!any(far)) return;
  for (int l = 0; l < kLanes; ++l)
    if (far[l]) sine[l] = std::sin(x[l]), cosine[l] = std::cos(x[l]);
}

// Quaternion of a rotation vector.
inline V4 exp_map(const V3& w) {
  const V square = dot(w, w);
  const I small = square < 1e-8f;
  const V angle = square_root(choose(small, all(1.0f), square));
  V sine, cosine;
  sine_cosine(0.5f * angle, sine, cosine);
  const V scale = choose(small, 0.5f - square * (1.0f / 48), sine / angle);
  return {choose(small, 1.0f - square * 0.125f, cosine), scale * w[0], scale * w[1],
          scale * w[2]};
}
