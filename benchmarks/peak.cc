// What one core can do: multiply-adds a second out of registers, bytes a second of a copy.

#include <chrono>
#include <cstring>
#include <vector>

#include "lanes.h"

namespace {
double seconds() {
  const auto now = std::chrono::steady_clock::now().time_since_epoch();
  return std::chrono::duration<double>(now).count();
}
}  // namespace

extern "C" double peak_operations() {
  V sum[12], scale = all(0.999f), shift = all(1e-3f);
  for (int i = 0; i < 12; ++i) sum[i] = all(0.1f * i);
  const int64_t rounds = 20000000;
  const double begin = seconds();
  for (int64_t n = 0; n < rounds; ++n)
    for (int i = 0; i < 12; ++i) sum[i] = sum[i] * scale + shift;
  const double took = seconds() - begin;
  volatile float kept = 0.0f;
  for (int i = 0; i < 12; ++i) kept = kept + sum[i][0];
  return 2.0 * 12 * kLanes * rounds / took;
}

extern "C" double copied_bytes(int64_t size) {
  std::vector<char> from(size, 1), to(size);
  const int64_t rounds = 1 + (int64_t(4) << 30) / size;
  const double begin = seconds();
  for (int64_t n = 0; n < rounds; ++n) {
    std::memcpy(to.data(), from.data(), size);
    asm volatile("" : : "r"(to.data()) : "memory");
  }
  return 2.0 * size * rounds / (seconds() - begin);
}
