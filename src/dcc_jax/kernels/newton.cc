// Mass matrix, contact rows and contact solver on a CPU, a vector register of environments
// at a time.
//
// M and the rows of the contacts are made here, in the parts in which the solver wants
// them: written out they are 4,500 numbers an environment, of which most are zero. The
// algorithm, its stopping rule and its order of limbs and core are those of
// contact_solver.py and arrowhead.py, which are the reference. What a block of
// environments needs stays in the CPU's cache through all iterations. Contacts that are
// apart in all of them are left out, rows that are inactive passed over.

#include <algorithm>
#include <cstring>
#include <vector>

#include "lanes.h"
#include "spatial.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

constexpr int kLineSearchIterations = 4;
constexpr float kFullStep = 1e-3f;
constexpr float kTiny = 1e-15f;

struct Entry {
  int at, high, low;  // in `mass`; the degrees of freedom, the farther from the root first
};

// A limb, or the core: its own unknowns, then those of the core that it is coupled with.
struct Part {
  int own;                     // how many of `dofs` are its own
  std::vector<int> dofs;       // of the scene
  std::vector<int> rows;       // constraint rows that touch it
  std::vector<int> live;       // places among them of those that may act; of a contact's
                               // four the first
  std::vector<int> in_core;    // where the coupled ones are among the core's
  std::vector<V> mass, front;  // lower triangles [i * size + j]
  std::vector<Entry> entries;  // of `mass` that are not zero
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
  const float* D;         // [E] of those rows
  const float* aref;      // [E] likewise
  const float* dist;      // [C] of contacts, negative where they touch
  const float* frame;     // [C, 9] normal and two tangents
  const float* point;     // [C, 3]
};

// What is constant of a contact (MuJoCo, "solver parameters").
struct Constants {
  float margin, friction[2], weight, stiffness, damping;
  float low, high, width, middle, power;  // of the impedance
};

// One block of environments. `parts` ends with the core.
struct Block {
  int nv, num_rows, num_equality, num_given, num_bodies, iterations;
  std::vector<Part> parts;
  std::vector<int> parent, body, root;  // [nv] of a degree of freedom
  std::vector<float> armature;          // [nv]
  std::vector<Constants> constants;     // [C]
  std::vector<int8_t> touching;         // [C] in any environment of the block
  std::vector<int> rows;                // that may act in any of them
  std::vector<int8_t> sign;             // [C * nv] how a dof moves a contact apart
  std::vector<V> motion, momentum;      // [nv * 6]
  std::vector<V> inertia, center, given_J, frame, point;  // as of `Given`
  std::vector<V> D, aref, depth, residual, slope, weight;
  std::vector<V> velocity, smooth, x, mass_x, search, mass_search, y, scaled;

  Block(ffi::Span<const int32_t> packed, ffi::Span<const float> numbers);
  void load(const Given& given, const int* env);
  void solve(const int* env, int count, float* qacc, float* force);

 private:
  int num_contacts() const { return (num_rows - num_given) / 4; }
  bool moves(int dof, int last) const;
  void make_masses();
  void make_rows(const Given& given, const int* env);
  void make_contact(Part& part, int r);
  void times_mass(const std::vector<V>& in, std::vector<V>& out) const;
  void times_rows(const std::vector<V>& in, std::vector<V>& out) const;
  I active(int row, V residual) const;
  template <int N>
  void times_some(const Part& part, int r, const std::vector<V>& in,
                  std::vector<V>& out) const;
  void assemble();
  template <int N>
  void assemble_some(Part& part, int r);
  template <int N>
  void eliminate(Part& part, int p);
  void factor();
  V line_search(V gauss_1, V gauss_2) const;
};

Block::Block(ffi::Span<const int32_t> packed, ffi::Span<const float> numbers) {
  const int32_t* at = packed.begin();
  for (int* number : {&nv, &num_rows, &num_equality, &num_given, &num_bodies})
    *number = *at++;
  for (auto* of_dof : {&parent, &body, &root}) {
    of_dof->assign(at, at + nv);
    at += nv;
  }
  for (int c = 0; c < num_contacts(); ++c, at += 2)
    for (int i = 0; i < nv; ++i) sign.push_back(moves(i, at[1]) - moves(i, at[0]));
  armature.assign(numbers.begin(), numbers.begin() + nv);
  constants.resize(num_contacts());
  touching.resize(num_contacts());
  depth.resize(num_contacts());
  std::memcpy(constants.data(), numbers.begin() + nv,
              num_contacts() * sizeof(Constants));
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
    // What couples the core's own unknowns is left to the core.
    for (int i = 0; i < size; ++i)
      for (int j = 0; j <= std::min(i, part.own - 1); ++j) {
        const auto [low, high] = std::minmax(part.dofs[i], part.dofs[j]);
        if (moves(low, high)) part.entries.push_back({i * size + j, high, low});
      }
    parts.push_back(std::move(part));
  }
  scaled.resize(3 * nv);
  for (auto* v : {&motion, &momentum}) v->resize(nv * 6);
  inertia.resize(10 * num_bodies), center.resize(3 * num_bodies);
  given_J.resize(num_given * nv);
  frame.resize(9 * num_contacts()), point.resize(3 * num_contacts());
  for (auto* v : {&D, &aref, &residual, &slope, &weight}) v->resize(num_rows);
  for (auto* v : {&velocity, &smooth, &x, &mass_x, &search, &mass_search, &y})
    v->resize(nv);
}

// Whether a body moves with a degree of freedom, by the last one that moves it.
bool Block::moves(int dof, int last) const {
  while (last > dof) last = parent[last];
  return last == dof;
}

void Block::load(const Given& given, const int* env) {
  const auto get = [&](const float* from, std::vector<V>& to) {
    ::load(from, to.size(), env, to.data());
  };
  get(given.velocity, velocity);
  get(given.smooth, smooth);
  get(given.start, x);
  get(given.motion, motion);
  get(given.inertia, inertia);
  get(given.center, center);
  get(given.J, given_J);
  get(given.dist, depth);
  get(given.frame, frame);
  get(given.point, point);
  make_masses();
  make_rows(given, env);
}

// M_ij = momentum of i's composite body along i, times the motion of its ancestor j.
void Block::make_masses() {
  for (int i = 0; i < nv; ++i)
    times_inertia(&inertia[10 * body[i]], &motion[6 * i], &momentum[6 * i]);
  for (Part& part : parts)
    for (const auto [at, high, low] : part.entries) {
      V sum = high == low ? all(armature[high]) : V{};
      for (int k = 0; k < 6; ++k) sum += momentum[6 * high + k] * motion[6 * low + k];
      part.mass[at] = sum;
    }
}

// The impedance of a contact, between `low` and `high`.
V impeded(const Constants& k, V depth) {
  const auto raised = [&](V x) {
    if (k.power == 1.0f) return x;
    if (k.power == 2.0f) return x * x;
    for (int l = 0; l < kLanes; ++l) x[l] = std::pow(x[l], k.power);
    return x;
  };
  const V x = choose(depth < 0.0f, -depth, depth) / k.width;
  const V rising = raised(x) / std::pow(k.middle, k.power - 1.0f);
  const V ending = 1.0f - raised(1.0f - x) / std::pow(1.0f - k.middle, k.power - 1.0f);
  const V y = choose(x < k.middle, rising, ending);
  const V between = clamp(k.low + y * (k.high - k.low), all(k.low), all(k.high));
  return choose(x > 1.0f, all(k.high), between);
}

void Block::make_rows(const Given& given, const int* env) {
  ::load(given.D, num_given, env, D.data());
  for (int c = 0; c < num_contacts(); ++c) {
    depth[c] -= constants[c].margin;
    touching[c] = any(depth[c] < 0.0f);
  }
  rows.clear();
  for (int r = 0; r < num_rows; ++r)
    if (r < num_given || touching[(r - num_given) / 4]) rows.push_back(r);
  for (Part& part : parts) {
    const int size = part.size();
    part.live.clear();
    for (int r = 0; r < static_cast<int>(part.rows.size()); ++r) {
      const int row = part.rows[r];
      if (row >= num_given) {
        const int c = (row - num_given) / 4;
        if (!touching[c] || (row - num_given) % 4) continue;
        make_contact(part, r);
      } else {
        for (int i = 0; i < size; ++i)
          part.J[r * size + i] = given_J[row * nv + part.dofs[i]];
      }
      part.live.push_back(r);
    }
  }
  times_rows(velocity, aref);
  ::load(given.aref, num_given, env, aref.data());
  for (int c = 0; c < num_contacts(); ++c) {
    if (!touching[c]) continue;
    const Constants& k = constants[c];
    const V deep = choose(depth[c] < 0.0f, depth[c], V{});
    const V impedance = impeded(k, deep);
    const V soft = k.weight * (1.0f - impedance) / impedance;
    for (int r = num_given + 4 * c; r < num_given + 4 * c + 4; ++r) {
      D[r] = 1.0f / choose(soft > kTiny, soft, all(kTiny));
      aref[r] = -k.stiffness * impedance * deep - k.damping * aref[r];
    }
  }
}

// The four edges of a contact's pyramid, normal +- friction * tangent: rows r to r + 3.
void Block::make_contact(Part& part, int r) {
  const int c = (part.rows[r] - num_given) / 4, size = part.size();
  V9 axes;
  for (int k = 0; k < 9; ++k) axes[k] = choose(depth[c] < 0.0f, frame[9 * c + k], V{});
  const float* friction = constants[c].friction;
  V* J = &part.J[r * size];
  V3 offset;
  int about = -1;
  for (int i = 0; i < size; ++i) {
    const int dof = part.dofs[i];
    const int apart = sign[c * nv + dof];
    if (apart && root[dof] != about) {
      about = root[dof];
      for (int k = 0; k < 3; ++k) offset[k] = point[3 * c + k] - center[3 * about + k];
    }
    V3 edge{};  // how the dof moves along normal and tangents
    if (apart) {
      auto speed = cross(&motion[6 * dof], offset.data());
      for (int k = 0; k < 3; ++k) speed[k] += motion[6 * dof + 3 + k];
      for (int k = 0; k < 3; ++k)
        edge[k] = float(apart) * (axes[3 * k] * speed[0] + axes[3 * k + 1] * speed[1] +
                                  axes[3 * k + 2] * speed[2]);
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
  for (const Part& part : parts)
    for (int r : part.live)
      part.rows[r] < num_given ? times_some<1>(part, r, in, out)
                               : times_some<4>(part, r, in, out);
}

// Of N rows, from r on. Sums that do not wait for one another are made at the same time.
template <int N>
void Block::times_some(const Part& part, int r, const std::vector<V>& in,
                       std::vector<V>& out) const {
  const int size = part.size();
  const V* J = &part.J[r * size];
  V sum[N] = {};
  for (int i = 0; i < size; ++i) {
    const V x = in[part.dofs[i]];
    for (int n = 0; n < N; ++n) sum[n] += J[n * size + i] * x;
  }
  for (int n = 0; n < N; ++n) out[part.rows[r] + n] = sum[n];
}

inline I Block::active(int row, V of) const {
  return row < num_equality ? ~I{} : of < 0.0f;
}

// fronts = M + J^T W J, and y = -(gradient).
void Block::assemble() {
  for (int i = 0; i < nv; ++i) y[i] = smooth[i] - mass_x[i];
  for (int r : rows)
    weight[r] = choose(active(r, residual[r]), D[r], V{});
  for (Part& part : parts) {
    const int size = part.size();
    for (int i = 0; i < size; ++i)
      for (int j = 0; j <= i; ++j)
        part.front[i * size + j] = j < part.own ? part.mass[i * size + j] : V{};
    for (int r : part.live)
      part.rows[r] < num_given ? assemble_some<1>(part, r) : assemble_some<4>(part, r);
  }
}

// What N rows add, from r on.
template <int N>
void Block::assemble_some(Part& part, int r) {
  const int size = part.size();
  const V* J = &part.J[r * size];
  V w[N], pull[N];
  I acts{};
  for (int n = 0; n < N; ++n) {
    w[n] = weight[part.rows[r] + n];
    pull[n] = w[n] * residual[part.rows[r] + n];
    acts |= w[n] != 0.0f;
  }
  if (!any(acts)) return;
  for (int i = 0; i < size; ++i) {
    V weighted[N], back{};
    for (int n = 0; n < N; ++n) {
      weighted[n] = w[n] * J[n * size + i];
      back += J[n * size + i] * pull[n];
    }
    y[part.dofs[i]] -= back;
    V* row = &part.front[i * size];
    for (int j = 0; j <= i; ++j) {
      V sum = row[j];
      for (int n = 0; n < N; ++n) sum += weighted[n] * J[n * size + j];
      row[j] = sum;
    }
  }
}

// Eliminates N unknowns of a part, from p on; below the diagonal the factors stay.
template <int N>
void Block::eliminate(Part& part, int p) {
  const int size = part.size(), next = p + N;
  V* F = part.front.data();
  for (int n = 0; n < N; ++n) {
    const int q = p + n;
    const V inverse = 1.0f / F[q * size + q], right = y[part.dofs[q]];
    for (int i = q + 1; i < size; ++i) {
      const V factor = F[i * size + q] * inverse;
      y[part.dofs[i]] -= factor * right;
      for (int j = q + 1; j < next && j <= i; ++j)
        F[i * size + j] -= factor * F[j * size + q];
      scaled[N * i + n] = factor;
    }
    F[q * size + q] = inverse;
  }
  for (int i = next; i < size; ++i)
    for (int j = next; j <= i; ++j) {
      V sum = F[i * size + j];
      for (int n = 0; n < N; ++n) sum -= scaled[N * i + n] * F[j * size + p + n];
      F[i * size + j] = sum;
    }
  for (int n = 0; n < N; ++n)
    for (int i = p + n + 1; i < size; ++i) F[i * size + p + n] = scaled[N * i + n];
}

// Eliminates limb after limb, then the core, and substitutes: search = H^-1 y.
void Block::factor() {
  Part& core = parts.back();
  const int width = core.size();
  for (Part& part : parts) {
    const int size = part.size();
    const V* F = part.front.data();
    int p = 0;
    for (; p + 3 <= part.own; p += 3) eliminate<3>(part, p);
    for (; p < part.own; ++p) eliminate<1>(part, p);
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
    for (int r : rows) {
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
  for (int r : rows) residual[r] -= aref[r];
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
    for (int r : rows) {
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
  store(x.data(), nv, env, count, qacc);
  std::fill(slope.begin(), slope.end(), V{});  // from here on the forces
  for (int r : rows) {
    const V at = residual[r];
    slope[r] = choose(active(r, at), -D[r] * at, 0.0f * at);
  }
  store(slope.data(), num_rows, env, count, force);
}

using Floats = ffi::Buffer<ffi::F32>;

ffi::Error Newton(Floats inertia, Floats motion, Floats center, Floats velocity,
                  Floats smooth, Floats start, Floats J, Floats D, Floats aref,
                  Floats dist, Floats frame, Floats point,
                  ffi::Buffer<ffi::S32> most, ffi::ResultBuffer<ffi::F32> qacc,
                  ffi::ResultBuffer<ffi::F32> force,
                  ffi::Span<const int32_t> structure, ffi::Span<const float> numbers) {
  const Given given{inertia.typed_data(),  motion.typed_data(), center.typed_data(),
                    velocity.typed_data(), smooth.typed_data(), start.typed_data(),
                    J.typed_data(),        D.typed_data(),      aref.typed_data(),
                    dist.typed_data(),     frame.typed_data(),  point.typed_data()};
  Block& block = kept<Block>(structure, numbers);
  block.iterations = most.typed_data()[0];  // the same for every environment of a batch
  const int64_t batch = smooth.element_count() / block.nv;
  for_each_block(batch, [&](const int* env, int count) {
    block.load(given, env);
    block.solve(env, count, qacc->typed_data(), force->typed_data());
  });
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
        .Arg<ffi::Buffer<ffi::S32>>()
        .Ret<Floats>()
        .Ret<Floats>()
        .Attr<ffi::Span<const int32_t>>("structure")
        .Attr<ffi::Span<const float>>("numbers"));
