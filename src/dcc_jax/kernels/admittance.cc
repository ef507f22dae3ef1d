// The displacement u of the law `admittance` a physics step later, on a CPU, a vector
// register of environments at a time.
//
// The reference is `control/compliance.py:admittance`, with the room of the joint ranges.

#include "lanes.h"
#include "spatial.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

constexpr float kPi = 3.14159265358979f;

// Where values come from and go to: one row an environment.
struct Given {
  const float *torque, *y, *yd, *alpha;
  const float *pose, *r, *lower, *upper, *per_lower, *per_upper, *turning;  // of `Room`
};
struct Made {
  float *u, *ud, *y, *yd;
};

struct Scalar {  // a coordinate that is no quaternion's
  int q, v;
};
struct Turn {  // a quaternion and its tangent
  int q, v, joint;  // -1: nothing bounds it
};
struct Spring {  // of a degree of freedom
  float per_kp, weight, driven, stiffness, damped;
};

V3 three(const V* of) { return {of[0], of[1], of[2]}; }

// One block of environments.
class Block {
 public:
  Block(ffi::Span<const int32_t> structure, ffi::Span<const float> numbers);
  void compute(const Given& given, const int* env);
  void store(const Made& made, const int* env, int count) const;
  int nv;

 private:
  void load(const Given& given, const int* env);
  V kept(V used) const;
  V used(const Turn& turn) const;
  V3 way(const Turn& turn, const V* tangent) const;
  V4 moved(const Turn& turn, const V* tangent) const;

  int nq, num_joints;
  float dt, linear_share, root_room;
  std::vector<Scalar> scalars;
  std::vector<Turn> turns;
  std::vector<Spring> springs;
  V alpha;
  std::vector<V> torque, rest, y, yd, u, ud;
  std::vector<V> pose, r, lower, upper, per_lower, per_upper, turning;
};

Block::Block(ffi::Span<const int32_t> structure, ffi::Span<const float> numbers) {
  const int32_t* whole = structure.begin();
  const float* real = numbers.begin();
  nq = *whole++, nv = *whole++, num_joints = *whole++;
  scalars.resize(*whole++);
  turns.resize(*whole++);
  for (Scalar& scalar : scalars) scalar.q = *whole++, scalar.v = *whole++;
  int joint = num_joints - static_cast<int>(turns.size());
  for (Turn& turn : turns) {
    turn.q = *whole++, turn.v = *whole++;
    turn.joint = std::max(joint++, -1);
  }
  dt = *real++, linear_share = *real++, root_room = *real++;
  springs.resize(nv);
  for (Spring& spring : springs) {
    spring.per_kp = 1.0f / *real++;
    spring.weight = *real++, spring.driven = *real++, spring.stiffness = *real++;
    const float slower = 1.0f + dt * std::sqrt(spring.stiffness);
    spring.damped = 1.0f / (slower * slower);
  }
  for (auto* of_dof : {&torque, &rest, &y, &yd, &ud}) of_dof->resize(nv);
  u.resize(nq);
  pose.resize(4 * num_joints), turning.resize(9 * num_joints);
  for (auto* bound : {&r, &lower, &upper, &per_lower, &per_upper})
    bound->resize(3 * num_joints);
}

void Block::load(const Given& given, const int* env) {
  alpha = gather(given.alpha, 1, env);
  const auto take = [&](const float* from, std::vector<V>& to) {
    ::load(from, to.size(), env, to.data());
  };
  take(given.torque, torque);
  take(given.y, y);
  take(given.yd, yd);
  take(given.pose, pose);
  take(given.r, r);
  take(given.lower, lower);
  take(given.upper, upper);
  take(given.per_lower, per_lower);
  take(given.per_upper, per_upper);
  take(given.turning, turning);
}

// The share that is left of what uses so much of its room: `ranges._shortened`.
V Block::kept(V used) const {
  const V beyond = (used - linear_share) * (1.0f / (1.0f - linear_share));
  const V left = linear_share + (1.0f - linear_share) * beyond / (1.0f + beyond);
  const I far = beyond > 0.0f;
  return choose(far, left / choose(far, used, all(1.0f)), all(1.0f));
}

// How a joint's rotation vector changes with its tangent.
V3 Block::way(const Turn& turn, const V* tangent) const {
  V9 matrix;
  std::copy_n(&turning[9 * turn.joint], 9, matrix.begin());
  return rotate(matrix, tangent);
}

// Share of its room that a joint's rest uses: `ranges.used`.
V Block::used(const Turn& turn) const {
  const V3 by = way(turn, &rest[turn.v]), tangent = three(&rest[turn.v]);
  V most = square_root(dot(tangent, tangent)) * (1.0f / kPi);
  for (int k = 0; k < 3; ++k) {
    const int i = 3 * turn.joint + k;
    const V up = by[k] * per_upper[i], down = -by[k] * per_lower[i];
    most = choose(most < up, up, most);
    most = choose(most < down, down, most);
  }
  return most;
}

// The quaternion of u that a tangent turns a joint by: `ranges.displaced`.
V4 Block::moved(const Turn& turn, const V* tangent) const {
  if (turn.joint < 0) return exp_map(three(tangent));
  V3 end = way(turn, tangent);
  for (int k = 0; k < 3; ++k) {
    const int i = 3 * turn.joint + k;
    end[k] = clamp(r[i] + end[k], lower[i], upper[i]);
  }
  const V* from = &pose[4 * turn.joint];
  const V4 back{from[0], -from[1], -from[2], -from[3]};
  V4 by = times_quat(back, exp_map(end).data());
  const I still = (tangent[0] == 0.0f) & (tangent[1] == 0.0f) & (tangent[2] == 0.0f);
  for (int k = 0; k < 4; ++k) by[k] = choose(still, all(k ? 0.0f : 1.0f), by[k]);
  return by;
}

void Block::compute(const Given& given, const int* env) {
  load(given, env);
  const V odds = alpha / (1.0f - alpha);
  for (int i = 0; i < nv; ++i) {
    const V softer = springs[i].weight * odds + springs[i].driven;
    rest[i] = softer * torque[i] * springs[i].per_kp;
  }
  V square = all(1e-12f);
  for (const Scalar& scalar : scalars) square += rest[scalar.v] * rest[scalar.v];
  const V nearer = kept(square_root(square) * (1.0f / root_room));
  for (const Scalar& scalar : scalars) rest[scalar.v] *= nearer;
  for (const Turn& turn : turns) {
    if (turn.joint < 0) continue;
    const V less = kept(used(turn));
    for (int k = 0; k < 3; ++k) rest[turn.v + k] *= less;
  }
  for (int i = 0; i < nv; ++i) {
    const Spring& spring = springs[i];
    yd[i] = (yd[i] - dt * spring.stiffness * (y[i] - rest[i])) * spring.damped;
    y[i] += dt * yd[i];
    const V by_u = spring.weight * odds, softer = by_u + spring.driven;
    const V share = by_u / choose(softer > 0.0f, softer, all(1.0f));
    ud[i] = share * yd[i];
    rest[i] = share * y[i];  // from here on the tangent of u
  }
  for (const Scalar& scalar : scalars) u[scalar.q] = rest[scalar.v];
  for (const Turn& turn : turns) {
    const V4 by = moved(turn, &rest[turn.v]);
    std::copy_n(by.begin(), 4, &u[turn.q]);
  }
}

void Block::store(const Made& made, const int* env, int count) const {
  ::store(u.data(), nq, env, count, made.u);
  ::store(ud.data(), nv, env, count, made.ud);
  ::store(y.data(), nv, env, count, made.y);
  ::store(yd.data(), nv, env, count, made.yd);
}

using Floats = ffi::Buffer<ffi::F32>;
using Result = ffi::ResultBuffer<ffi::F32>;

ffi::Error Admittance(Floats torque, Floats y, Floats yd, Floats alpha, Floats pose,
                      Floats r, Floats lower, Floats upper, Floats per_lower,
                      Floats per_upper, Floats turning, Result u, Result ud,
                      Result y_after, Result yd_after,
                      ffi::Span<const int32_t> structure,
                      ffi::Span<const float> numbers) {
  const Given given{torque.typed_data(),    y.typed_data(),         yd.typed_data(),
                    alpha.typed_data(),     pose.typed_data(),      r.typed_data(),
                    lower.typed_data(),     upper.typed_data(),     per_lower.typed_data(),
                    per_upper.typed_data(), turning.typed_data()};
  const Made made{u->typed_data(), ud->typed_data(), y_after->typed_data(),
                  yd_after->typed_data()};
  Block& block = ::kept<Block>(structure, numbers);
  for_each_block(torque.element_count() / block.nv, [&](const int* env, int count) {
    block.compute(given, env);
    block.store(made, env, count);
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(dcc_admittance, Admittance,
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
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Attr<ffi::Span<const int32_t>>("structure")
                                  .Attr<ffi::Span<const float>>("numbers"));
