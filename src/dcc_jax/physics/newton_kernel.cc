// The contact solver on a CPU: `contact_solver.newton`, a vector register of environments
// at a time.
//
// The algorithm, its stopping rule and its order of limbs and core are those of
// contact_solver.py and arrowhead.py, which are the reference. Here a number is a vector,
// a lane an environment. What a block of them needs stays in the CPU's cache through all
// iterations, and rows that are inactive in all of them are passed over.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

// As many as a vector register holds: wider vectors would be taken apart in memory.
#if defined(__AVX512F__)
constexpr int kLanes = 16;
#else
constexpr int kLanes = 8;
#endif
constexpr int kLineSearchIterations = 4;
constexpr float kFullStep = 1e-3f;

typedef float V __attribute__((vector_size(4 * kLanes)));
typedef int32_t I __attribute__((vector_size(4 * kLanes)));

inline V all(float x) { return x - V{}; }
inline V choose(I where, V yes, V no) { return where ? yes : no; }

inline bool any(I where) {
  int32_t found = 0;
  for (int l = 0; l < kLanes; ++l) found |= where[l];
  return found != 0;
}

// A limb, or the core: its own unknowns, then those of the core that it is coupled with.
struct Part {
  int own;                     // how many of `dofs` are its own
  std::vector<int> dofs;       // of the scene
  std::vector<int> rows;       // constraint rows that touch it
  std::vector<int> in_core;    // where the coupled ones are among the core's
  std::vector<V> mass, front;  // lower triangles [i * size + j]
  std::vector<V> J;            // [row * size + i]

  int size() const { return static_cast<int>(dofs.size()); }
};

// One block of environments. `parts` ends with the core.
struct Block {
  int nv, num_rows, num_equality, iterations;
  std::vector<Part> parts;
  std::vector<V> D, aref, residual, slope, weight;
  std::vector<V> smooth, x, mass_x, search, mass_search, y;

  explicit Block(ffi::Span<const int32_t> packed, int iterations);
  void load(const float* mass, const float* smooth, const float* J, const float* D,
            const float* aref, const float* start, const int* env);
  void solve(const int* env, int count, float* qacc, float* force);

 private:
  void times_mass(const std::vector<V>& in, std::vector<V>& out) const;
  void times_rows(const std::vector<V>& in, std::vector<V>& out) const;
  I active(int row, V residual) const;
  void assemble();
  void factor();
  V line_search(V gauss_1, V gauss_2) const;
};

Block::Block(ffi::Span<const int32_t> packed, int iterations) : iterations(iterations) {
  const int32_t* at = packed.begin();
  nv = *at++;
  num_rows = *at++;
  num_equality = *at++;
  const int count = *at++;
  for (int p = 0; p < count; ++p) {
    Part part;
    part.own = *at++;
    const int coupled = *at++, rows = *at++, size = part.own + coupled;
    part.dofs.assign(at, at + size);
    at += size;
    part.in_core.assign(at, at + coupled);
    at += coupled;
    part.rows.assign(at, at + rows);
    at += rows;
    part.mass.resize(size * size);
    part.front.resize(size * size);
    part.J.resize(rows * size);
    parts.push_back(std::move(part));
  }
  for (auto* v : {&D, &aref, &residual, &slope, &weight}) v->resize(num_rows);
  for (auto* v : {&smooth, &x, &mass_x, &search, &mass_search, &y}) v->resize(nv);
}

// A value of each environment; they lie `stride` apart in memory.
inline V gather(const float* from, int64_t stride, const int* env) {
  V out;
  for (int l = 0; l < kLanes; ++l) out[l] = from[stride * env[l]];
  return out;
}

void Block::load(const float* mass, const float* smooth_in, const float* J,
                 const float* D_in, const float* aref_in, const float* start,
                 const int* env) {
  const int64_t square = int64_t(nv) * nv, wide = int64_t(num_rows) * nv;
  for (Part& part : parts) {
    const int size = part.size();
    for (int i = 0; i < size; ++i) {
      // What couples the core's own unknowns is left to the core.
      for (int j = 0; j <= std::min(i, part.own - 1); ++j)
        part.mass[i * size + j] =
            gather(mass + int64_t(part.dofs[i]) * nv + part.dofs[j], square, env);
    }
    for (size_t r = 0; r < part.rows.size(); ++r)
      for (int i = 0; i < size; ++i)
        part.J[r * size + i] =
            gather(J + int64_t(part.rows[r]) * nv + part.dofs[i], wide, env);
  }
  for (int r = 0; r < num_rows; ++r) {
    D[r] = gather(D_in + r, num_rows, env);
    aref[r] = gather(aref_in + r, num_rows, env);
  }
  for (int i = 0; i < nv; ++i) {
    smooth[i] = gather(smooth_in + i, nv, env);
    x[i] = gather(start + i, nv, env);
  }
}

void Block::times_mass(const std::vector<V>& in, std::vector<V>& out) const {
  std::fill(out.begin(), out.end(), V{});
  for (const Part& part : parts) {
    const int size = part.size();
    for (int i = 0; i < size; ++i) {
      const V* row = &part.mass[i * size];
      const V own = in[part.dofs[i]];
      V sum{};
      for (int j = 0; j < std::min(i, part.own); ++j) {
        sum += row[j] * in[part.dofs[j]];
        out[part.dofs[j]] += row[j] * own;
      }
      if (i < part.own) sum += row[i] * own;
      out[part.dofs[i]] += sum;
    }
  }
}

void Block::times_rows(const std::vector<V>& in, std::vector<V>& out) const {
  for (const Part& part : parts) {
    const int size = part.size();
    for (size_t r = 0; r < part.rows.size(); ++r) {
      V sum{};
      for (int i = 0; i < size; ++i) sum += part.J[r * size + i] * in[part.dofs[i]];
      out[part.rows[r]] = sum;
    }
  }
}

inline I Block::active(int row, V of) const {
  return row < num_equality ? ~I{} : of < 0.0f;
}

// fronts = M + J^T W J, and y = -(gradient).
void Block::assemble() {
  for (int i = 0; i < nv; ++i) y[i] = smooth[i] - mass_x[i];
  for (int r = 0; r < num_rows; ++r)
    weight[r] = choose(active(r, residual[r]), D[r], V{});
  for (Part& part : parts) {
    const int size = part.size();
    for (int i = 0; i < size; ++i)
      for (int j = 0; j <= i; ++j)
        part.front[i * size + j] = j < part.own ? part.mass[i * size + j] : V{};
    for (size_t r = 0; r < part.rows.size(); ++r) {
      const V w = weight[part.rows[r]];
      if (!any(w != 0.0f)) continue;
      const V pull = w * residual[part.rows[r]];
      const V* J = &part.J[r * size];
      for (int i = 0; i < size; ++i) {
        y[part.dofs[i]] -= J[i] * pull;
        const V weighted = w * J[i];
        V* row = &part.front[i * size];
        for (int j = 0; j <= i; ++j) row[j] += weighted * J[j];
      }
    }
  }
}

// Eliminates limb after limb, then the core, and substitutes: search = H^-1 y.
void Block::factor() {
  Part& core = parts.back();
  const int width = core.size();
  V scaled[64];
  for (Part& part : parts) {
    const int size = part.size();
    V* F = part.front.data();
    for (int p = 0; p < part.own; ++p) {
      const V inverse = 1.0f / F[p * size + p];
      const V right = y[part.dofs[p]];
      for (int i = p + 1; i < size; ++i) {
        scaled[i] = F[i * size + p] * inverse;
        y[part.dofs[i]] -= scaled[i] * right;
        V* row = F + i * size;
        for (int j = p + 1; j <= i; ++j) row[j] -= scaled[i] * F[j * size + p];
      }
      for (int i = p + 1; i < size; ++i) F[i * size + p] = scaled[i];
      F[p * size + p] = inverse;
    }
    if (&part == &core) break;
    for (int i = part.own; i < size; ++i)
      for (int j = part.own; j <= i; ++j) {
        const int a = part.in_core[i - part.own], b = part.in_core[j - part.own];
        core.front[std::max(a, b) * width + std::min(a, b)] += F[i * size + j];
      }
  }
  for (auto part = parts.rbegin(); part != parts.rend(); ++part) {
    const int size = part->size();
    const V* F = part->front.data();
    for (int p = part->own - 1; p >= 0; --p) {
      V value = y[part->dofs[p]] * F[p * size + p];
      for (int i = p + 1; i < size; ++i)
        value -= F[i * size + p] * search[part->dofs[i]];
      search[part->dofs[p]] = value;
    }
  }
}

V Block::line_search(V gauss_1, V gauss_2) const {
  V low{}, high = all(4.0f), t = all(1.0f);
  for (int n = 0; n < kLineSearchIterations; ++n) {
    V first = gauss_1 + t * gauss_2, second = gauss_2;
    for (int r = 0; r < num_rows; ++r) {
      const V at = residual[r] + t * slope[r];
      const V weighted = choose(active(r, at), D[r], V{}) * slope[r];
      first += weighted * at;
      second += weighted * slope[r];
    }
    low = choose(first < 0.0f, t, low);
    high = choose(first < 0.0f, high, t);
    const V proposed = t - first / choose(second > 1e-12f, second, all(1e-12f));
    const I inside = (proposed >= low) & (proposed <= high);
    t = choose(inside, proposed, 0.5f * (low + high));
  }
  return t;
}

void Block::solve(const int* env, int count, float* qacc, float* force) {
  times_mass(x, mass_x);
  times_rows(x, residual);
  for (int r = 0; r < num_rows; ++r) residual[r] -= aref[r];
  I done{};
  for (int n = 0; n < iterations && any(~done); ++n) {
    assemble();
    factor();
    times_rows(search, slope);
    times_mass(search, mass_search);
    V gauss_1{}, gauss_2{};
    for (int i = 0; i < nv; ++i) {
      gauss_1 += search[i] * (mass_x[i] - smooth[i]);
      gauss_2 += search[i] * mass_search[i];
    }
    const V step = choose(done, V{}, line_search(gauss_1, gauss_2));
    I same = ~I{};
    for (int r = 0; r < num_rows; ++r) {
      const V moved = residual[r] + step * slope[r];
      same &= active(r, moved) == active(r, residual[r]);
      residual[r] = moved;
    }
    for (int i = 0; i < nv; ++i) {
      x[i] += step * search[i];
      mass_x[i] += step * mass_search[i];
    }
    const V off = choose(step < 1.0f, 1.0f - step, step - 1.0f);
    // Written so that what is not a number is done as well.
    done |= same & ~(off > kFullStep);
  }
  for (int l = 0; l < count; ++l) {
    for (int i = 0; i < nv; ++i) qacc[int64_t(env[l]) * nv + i] = x[i][l];
    for (int r = 0; r < num_rows; ++r) {
      const float at = residual[r][l];
      const bool acts = r < num_equality || at < 0.0f;
      force[int64_t(env[l]) * num_rows + r] = acts ? -D[r][l] * at : 0.0f * at;
    }
  }
}

ffi::Error Newton(ffi::Buffer<ffi::F32> mass, ffi::Buffer<ffi::F32> smooth,
                  ffi::Buffer<ffi::F32> J, ffi::Buffer<ffi::F32> D,
                  ffi::Buffer<ffi::F32> aref, ffi::Buffer<ffi::F32> start,
                  ffi::Buffer<ffi::S32> most,
                  ffi::ResultBuffer<ffi::F32> qacc, ffi::ResultBuffer<ffi::F32> force,
                  ffi::Span<const int32_t> structure) {
  // The same number for every environment of a batch.
  Block block(structure, most.typed_data()[0]);
  const int64_t batch = smooth.element_count() / block.nv;
  for (int64_t first = 0; first < batch; first += kLanes) {
    int env[kLanes];
    const int count = static_cast<int>(std::min<int64_t>(kLanes, batch - first));
    for (int l = 0; l < kLanes; ++l)
      env[l] = static_cast<int>(first) + std::min(l, count - 1);
    block.load(mass.typed_data(), smooth.typed_data(), J.typed_data(), D.typed_data(),
               aref.typed_data(), start.typed_data(), env);
    block.solve(env, count, qacc->typed_data(), force->typed_data());
  }
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(
    dcc_newton, Newton,
    ffi::Ffi::Bind()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::F32>>()
        .Arg<ffi::Buffer<ffi::S32>>()
        .Ret<ffi::Buffer<ffi::F32>>()
        .Ret<ffi::Buffer<ffi::F32>>()
        .Attr<ffi::Span<const int32_t>>("structure"));
