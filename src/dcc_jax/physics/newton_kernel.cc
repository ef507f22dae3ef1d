// Mass matrix, contact rows and contact solver on a CPU, a vector register of environments
// at a time.
//
// M and the rows of the contacts are made here, in the parts in which the solver wants
// them: written out they are 4,500 numbers an environment, of which most are zero. The
// algorithm, its stopping rule and its order of limbs and core are those of
// contact_solver.py and arrowhead.py, which are the reference. Here a number is a vector,
// a lane an environment. What a block of them needs stays in the CPU's cache through all
// iterations, and rows that are inactive in all of them are passed over.

#include <algorithm>
#include <array>
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

// What the kernel is given: one row an environment, but for `iterations`.
struct Given {
  const float* inertia;   // [nbody, 10] of the composite bodies (MJX's crb)
  const float* motion;    // [nv, 6] axes of motion, angular then linear (MJX's cdof)
  const float* center;    // [nbody, 3] that the linear parts are about
  const float* velocity;  // [nv]
  const float* smooth;    // [nv]
  const float* start;     // [nv]
  const float* J;         // [E, nv] rows of equalities and limits
  const float* D;         // [E + C] of those rows, then of the contacts
  const float* aref;      // [E + C] likewise; of a contact without its damping
  const float* frame;     // [C, 9] normal and two tangents; zero where it is apart
  const float* point;     // [C, 3]
  const float* friction;  // [C, 2]
  const float* damping;   // [C]
};

// One block of environments. `parts` ends with the core.
struct Block {
  int nv, num_rows, num_equality, num_given, num_bodies, iterations;
  std::vector<Part> parts;
  std::vector<int> parent, body, root;  // [nv] of a degree of freedom
  std::vector<float> armature;          // [nv]
  std::vector<int8_t> sign;             // [C * nv] how a dof moves a contact apart
  std::vector<V> motion, momentum;      // [nv * 6]
  std::vector<V> D, aref, residual, slope, weight;
  std::vector<V> velocity, smooth, x, mass_x, search, mass_search, y;

  Block(ffi::Span<const int32_t> packed, ffi::Span<const float> armature,
        int iterations);
  void load(const Given& given, const int* env);
  void solve(const int* env, int count, float* qacc, float* force);

 private:
  int num_contacts() const { return (num_rows - num_given) / 4; }
  bool moves(int dof, int last) const;
  void load_masses(const Given& given, const int* env);
  void load_rows(const Given& given, const int* env);
  void load_contact(Part& part, int r, const Given& given, const int* env);
  void times_mass(const std::vector<V>& in, std::vector<V>& out) const;
  void times_rows(const std::vector<V>& in, std::vector<V>& out) const;
  I active(int row, V residual) const;
  void assemble();
  void factor();
  V line_search(V gauss_1, V gauss_2) const;
};

Block::Block(ffi::Span<const int32_t> packed, ffi::Span<const float> diagonal,
             int iterations)
    : iterations(iterations), armature(diagonal.begin(), diagonal.end()) {
  const int32_t* at = packed.begin();
  for (int* number : {&nv, &num_rows, &num_equality, &num_given, &num_bodies})
    *number = *at++;
  for (auto* of_dof : {&parent, &body, &root}) {
    of_dof->assign(at, at + nv);
    at += nv;
  }
  for (int c = 0; c < num_contacts(); ++c, at += 2)
    for (int i = 0; i < nv; ++i) sign.push_back(moves(i, at[1]) - moves(i, at[0]));
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
  for (auto* v : {&motion, &momentum}) v->resize(nv * 6);
  for (auto* v : {&D, &aref, &residual, &slope, &weight}) v->resize(num_rows);
  for (auto* v : {&velocity, &smooth, &x, &mass_x, &search, &mass_search, &y})
    v->resize(nv);
}

// Whether a body moves with a degree of freedom, by the last one that moves it.
bool Block::moves(int dof, int last) const {
  while (last > dof) last = parent[last];
  return last == dof;
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

inline std::array<V, 3> cross(const V* a, const V* b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
          a[0] * b[1] - a[1] * b[0]};
}

// The momentum of a body with the spatial inertia I that moves along m.
inline void times_inertia(const std::array<V, 10>& I, const V* m, V* out) {
  const V* offset = &I[6];
  const auto tilt = cross(offset, m + 3), lift = cross(offset, m);
  out[0] = I[0] * m[0] + I[3] * m[1] + I[4] * m[2] + tilt[0];
  out[1] = I[3] * m[0] + I[1] * m[1] + I[5] * m[2] + tilt[1];
  out[2] = I[4] * m[0] + I[5] * m[1] + I[2] * m[2] + tilt[2];
  for (int k = 0; k < 3; ++k) out[3 + k] = I[9] * m[3 + k] - lift[k];
}

void Block::load(const Given& given, const int* env) {
  for (int i = 0; i < nv; ++i) {
    velocity[i] = gather(given.velocity + i, nv, env);
    smooth[i] = gather(given.smooth + i, nv, env);
    x[i] = gather(given.start + i, nv, env);
  }
  load_masses(given, env);
  load_rows(given, env);
}

// M_ij = momentum of i's composite body along i, times the motion of its ancestor j.
void Block::load_masses(const Given& given, const int* env) {
  std::array<V, 10> inertia;
  for (int i = 0; i < nv; ++i) {
    for (int k = 0; k < 6; ++k)
      motion[6 * i + k] = gather(given.motion + 6 * i + k, 6 * nv, env);
    if (!i || body[i] != body[i - 1])
      inertia = gather<10>(given.inertia + 10 * body[i], 10 * num_bodies, env);
    times_inertia(inertia, &motion[6 * i], &momentum[6 * i]);
  }
  for (Part& part : parts) {
    const int size = part.size();
    for (int i = 0; i < size; ++i) {
      // What couples the core's own unknowns is left to the core.
      for (int j = 0; j <= std::min(i, part.own - 1); ++j) {
        const int high = std::max(part.dofs[i], part.dofs[j]);
        const int low = std::min(part.dofs[i], part.dofs[j]);
        V sum{};
        if (moves(low, high))
          for (int k = 0; k < 6; ++k) sum += momentum[6 * high + k] * motion[6 * low + k];
        part.mass[i * size + j] = i == j ? sum + armature[high] : sum;
      }
    }
  }
}

void Block::load_rows(const Given& given, const int* env) {
  const int total = num_given + num_contacts();
  for (int r = 0; r < num_rows; ++r) {
    const int at = r < num_given ? r : num_given + (r - num_given) / 4;
    D[r] = gather(given.D + at, total, env);
  }
  for (Part& part : parts) {
    const int size = part.size();
    for (size_t r = 0; r < part.rows.size(); ++r) {
      const int row = part.rows[r];
      if (row >= num_given) {
        if ((row - num_given) % 4 == 0) load_contact(part, r, given, env);
        continue;
      }
      for (int i = 0; i < size; ++i)
        part.J[r * size + i] = gather(given.J + int64_t(row) * nv + part.dofs[i],
                                      int64_t(num_given) * nv, env);
    }
  }
  times_rows(velocity, aref);
  for (int r = 0; r < num_rows; ++r) {
    const int c = (r - num_given) / 4;
    if (r < num_given)
      aref[r] = gather(given.aref + r, total, env);
    else
      aref[r] = gather(given.aref + num_given + c, total, env) -
                gather(given.damping + c, num_contacts(), env) * aref[r];
  }
}

// The four edges of a contact's pyramid, normal +- friction * tangent: rows r to r + 3.
void Block::load_contact(Part& part, int r, const Given& given, const int* env) {
  const int c = (part.rows[r] - num_given) / 4, size = part.size();
  const int64_t count = num_contacts();
  const auto frame = gather<9>(given.frame + 9 * c, 9 * count, env);
  const auto point = gather<3>(given.point + 3 * c, 3 * count, env);
  const auto friction = gather<2>(given.friction + 2 * c, 2 * count, env);
  V* J = &part.J[r * size];
  std::array<V, 3> offset;
  int about = -1;
  for (int i = 0; i < size; ++i) {
    const int dof = part.dofs[i];
    const int apart = sign[c * nv + dof];
    if (apart && root[dof] != about) {
      about = root[dof];
      const auto center = gather<3>(given.center + 3 * about, 3 * num_bodies, env);
      for (int k = 0; k < 3; ++k) offset[k] = point[k] - center[k];
    }
    std::array<V, 3> edge{};  // how the dof moves along normal and tangents
    if (apart) {
      auto speed = cross(&motion[6 * dof], offset.data());
      for (int k = 0; k < 3; ++k) speed[k] += motion[6 * dof + 3 + k];
      for (int k = 0; k < 3; ++k)
        edge[k] = float(apart) * (frame[3 * k] * speed[0] + frame[3 * k + 1] * speed[1] +
                                  frame[3 * k + 2] * speed[2]);
    }
    for (int t = 0; t < 2; ++t) {
      J[2 * t * size + i] = edge[0] + friction[t] * edge[1 + t];
      J[(2 * t + 1) * size + i] = edge[0] - friction[t] * edge[1 + t];
    }
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

using Floats = ffi::Buffer<ffi::F32>;

ffi::Error Newton(Floats inertia, Floats motion, Floats center, Floats velocity,
                  Floats smooth, Floats start, Floats J, Floats D, Floats aref,
                  Floats frame, Floats point, Floats friction, Floats damping,
                  ffi::Buffer<ffi::S32> most, ffi::ResultBuffer<ffi::F32> qacc,
                  ffi::ResultBuffer<ffi::F32> force,
                  ffi::Span<const int32_t> structure, ffi::Span<const float> armature) {
  const Given given{inertia.typed_data(),  motion.typed_data(),   center.typed_data(),
                    velocity.typed_data(), smooth.typed_data(),   start.typed_data(),
                    J.typed_data(),        D.typed_data(),        aref.typed_data(),
                    frame.typed_data(),    point.typed_data(),    friction.typed_data(),
                    damping.typed_data()};
  // The same number for every environment of a batch.
  Block block(structure, armature, most.typed_data()[0]);
  const int64_t batch = smooth.element_count() / block.nv;
  for (int64_t first = 0; first < batch; first += kLanes) {
    int env[kLanes];
    const int count = static_cast<int>(std::min<int64_t>(kLanes, batch - first));
    for (int l = 0; l < kLanes; ++l)
      env[l] = static_cast<int>(first) + std::min(l, count - 1);
    block.load(given, env);
    block.solve(env, count, qacc->typed_data(), force->typed_data());
  }
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(
    dcc_newton, Newton,
    ffi::Ffi::Bind()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<Floats>()
        .Arg<ffi::Buffer<ffi::S32>>()
        .Ret<Floats>()
        .Ret<Floats>()
        .Attr<ffi::Span<const int32_t>>("structure")
        .Attr<ffi::Span<const float>>("armature"));
