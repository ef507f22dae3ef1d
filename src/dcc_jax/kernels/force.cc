// Generalized forces of forces at points of bodies on a CPU, a vector register of
// environments at a time.
//
// The reference is `physics/step.py:generalized_force`. Parents come before their children.

#include "lanes.h"
#include "spatial.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

struct Given {  // one row an environment
  const float *point, *force;  // [F, 3]
  const int32_t* body;         // [F]
  const float *center, *motion;  // [nbody, 3], [nv, 6]
  int64_t count;               // F
};

// One block of environments.
class Block {
 public:
  Block(ffi::Span<const int32_t> structure, ffi::Span<const float> numbers);
  void compute(const Given& given, const int* env);
  void store(float* made, const int* env, int count) const {
    ::store(torque.data(), nv, env, count, made);
  }
  int nv;

 private:
  bool pull(const Given& given, const int* env, int64_t f);

  std::vector<int> parent, root, moved;  // of bodies, and the body that a dof moves
  std::vector<V6> wrench;                // on each body, about its tree's centre of mass
  std::vector<V> motion, torque;
  I acts;  // whether any force does
};

Block::Block(ffi::Span<const int32_t> structure, ffi::Span<const float>) {
  const int32_t* whole = structure.begin();
  nv = *whole++;
  const int bodies = *whole++;
  parent.assign(whole, whole + bodies);
  root.assign(whole + bodies, whole + 2 * bodies);
  moved.assign(whole + 2 * bodies, whole + 2 * bodies + nv);
  wrench.resize(bodies);
  motion.resize(6 * nv), torque.resize(nv);
}

// A force and its moment, on the body of each lane; whether there is any.
bool Block::pull(const Given& given, const int* env, int64_t f) {
  V3 lever, force;
  for (int l = 0; l < kLanes; ++l)
    for (int k = 0; k < 3; ++k)
      force[k][l] = given.force[3 * (given.count * env[l] + f) + k];
  const I here = (force[0] != 0.0f) | (force[1] != 0.0f) | (force[2] != 0.0f);
  if (!any(here)) return false;
  acts |= here;
  int body[kLanes];
  const int last = wrench.size() - 1;
  bool alike = true;
  for (int l = 0; l < kLanes; ++l) {
    const int64_t at = given.count * env[l] + f;
    body[l] = std::clamp(given.body[at], 0, last);
    alike &= body[l] == body[0];
    const float* center = given.center + 3 * (wrench.size() * env[l] + root[body[l]]);
    for (int k = 0; k < 3; ++k) lever[k][l] = given.point[3 * at + k] - center[k];
  }
  const V3 moment = cross(lever, force);
  const V6 all{moment[0], moment[1], moment[2], force[0], force[1], force[2]};
  for (int k = 0; k < 6; ++k) {
    if (alike)
      wrench[body[0]][k] += all[k];
    else
      for (int l = 0; l < kLanes; ++l) wrench[body[l]][k][l] += all[k][l];
  }
  return true;
}

void Block::compute(const Given& given, const int* env) {
  std::fill(torque.begin(), torque.end(), V{});
  std::fill(wrench.begin(), wrench.end(), V6{});
  acts = I{};
  bool pulled = false;
  for (int64_t f = 0; f < given.count; ++f) pulled |= pull(given, env, f);
  if (!pulled) return;
  load(given.motion, motion.size(), env, motion.data());
  for (size_t b = wrench.size() - 1; b > 0; --b)
    for (int k = 0; k < 6; ++k) wrench[parent[b]][k] += wrench[b][k];
  for (int dof = 0; dof < nv; ++dof) {
    V sum{};
    for (int k = 0; k < 6; ++k) sum += motion[6 * dof + k] * wrench[moved[dof]][k];
    torque[dof] = choose(acts, sum, V{});
  }
}

using Floats = ffi::Buffer<ffi::F32>;

ffi::Error Force(Floats point, ffi::Buffer<ffi::S32> body, Floats force, Floats center,
                 Floats motion, ffi::ResultBuffer<ffi::F32> torque,
                 ffi::Span<const int32_t> structure) {
  Block& block = kept<Block>(structure, ffi::Span<const float>());
  const int64_t batch = torque->element_count() / block.nv;
  const Given given{point.typed_data(),  force.typed_data(),  body.typed_data(),
                    center.typed_data(), motion.typed_data(),
                    static_cast<int64_t>(body.element_count()) / batch};
  for_each_block(batch, [&](const int* env, int count) {
    block.compute(given, env);
    block.store(torque->typed_data(), env, count);
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(dcc_force, Force,
                              ffi::Ffi::Bind()
                                  .Arg<Floats>()
                                  .Arg<ffi::Buffer<ffi::S32>>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Ret<Floats>()
                                  .Attr<ffi::Span<const int32_t>>("structure"));
