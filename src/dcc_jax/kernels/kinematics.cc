// Poses, motion axes, composite inertias, bias forces and contacts of a tree of bodies on
// a CPU, a vector register of environments at a time.
//
// The algorithms are MJX's (kinematics, com_pos, crb, com_vel, rne, collision), which are
// the reference. Parents come before their children.

#include "collision.h"
#include "lanes.h"
#include "spatial.h"
#include "xla/ffi/api/ffi.h"

namespace ffi = xla::ffi;

namespace {

constexpr float kTiny = 1e-15f;
enum JointType { kFree, kBall, kSlide, kHinge };
enum Kind {
  kPlaneSphere,
  kPlaneCapsule,
  kSphereSphere,
  kSphereCapsule,
  kSphereBox,
  kCapsuleCapsule,
  kCapsuleBox
};

struct Pose {
  float pos[3], quat[4], mat[9];
  bool turned;  // whether the rotation is not the identity
};

struct Joint {
  int type, qpos, dof;  // where it begins in qpos and qvel
  float pos[3], axis[3], zero;

  int turns() const { return type == kFree || type == kBall ? 3 : type == kHinge; }
  int dofs() const { return type == kFree ? 6 : type == kBall ? 3 : 1; }
};

struct Body {
  int parent, root, mocap;  // -1: moved by joints
  std::vector<Joint> joints;
  Pose pose, inertial;  // relative to the parent; of the centre of mass to the body
  float inertia[3], mass, tree_mass;
};

struct Attached {  // a geom or a site
  int body;
  Pose pose;
  float size[3];
};

struct Pair {  // of geoms that may touch, in one slot or two
  int kind, one, other;

  int slots() const { return kind == kPlaneCapsule || kind == kCapsuleBox ? 2 : 1; }
};

// A rotation by an angle about a constant axis.
V4 about(const float* axis, V angle) {
  V4 out;
  for (int l = 0; l < kLanes; ++l) {
    const float half = 0.5f * angle[l], s = std::sin(half);
    out[0][l] = std::cos(half);
    for (int k = 0; k < 3; ++k) out[1 + k][l] = s * axis[k];
  }
  return out;
}

// Where values come from and go to: one row an environment. Null: nobody wants them.
struct Given {
  const float *qpos, *qvel, *mocap_pos, *mocap_quat;
};
struct Made {
  float *pos, *quat, *mat, *center;      // of bodies [nbody, 3 4 9 3]
  float *geom_pos, *geom_mat;            // [ngeom, 3 9]
  float *site_pos, *site_mat;            // [nsite, 3 9]
  float *tree_center, *motion, *inertia; // [nbody, 3], [nv, 6], [nbody, 10] composite
  float* bias;                           // [nv]
  float *dist, *point, *frame;           // of contacts [C, 1 3 9]
};

// One block of environments.
class Block {
 public:
  Block(ffi::Span<const int32_t> structure, ffi::Span<const float> numbers);
  void compute(const Given& given, const int* env);
  void store(const Made& made, const int* env, int count) const;
  int nq, nv;

 private:
  void load(const Given& given, const int* env);
  void place(int b);
  void move_axes(int b);
  void feel_inertia(int b);
  void resist();
  void attach(const std::vector<Attached>& all, std::vector<V3>& at,
              std::vector<V9>& turned) const;
  void touch();

  int num_mocap;
  float gravity[3];
  std::vector<Body> bodies;
  std::vector<Attached> geoms, sites;
  std::vector<Pair> pairs;
  std::vector<V3> point, pos, center, tree_center, geom_pos, site_pos, anchor, axis;
  std::vector<V4> quat;
  std::vector<V9> frame, mat, geom_mat, site_mat;
  std::vector<V10> inertia, composite;
  std::vector<V6> motion, velocity, acceleration, force;
  std::vector<V> qpos, qvel, mocap_pos, mocap_quat, dist, bias;
};

struct Reader {
  const int32_t* whole;
  const float* real;

  int next() { return *whole++; }
  void next(float* out, int count) {
    for (int i = 0; i < count; ++i) out[i] = *real++;
  }
  Pose pose() {
    Pose out;
    next(out.pos, 3);
    next(out.quat, 4);
    to_matrix(out.quat, out.mat);
    out.turned = out.quat[1] || out.quat[2] || out.quat[3];
    return out;
  }
};

Block::Block(ffi::Span<const int32_t> structure, ffi::Span<const float> numbers) {
  Reader read{structure.begin(), numbers.begin()};
  nq = read.next(), nv = read.next(), num_mocap = read.next();
  bodies.resize(read.next());
  geoms.resize(read.next());
  sites.resize(read.next());
  pairs.resize(read.next());
  read.next(gravity, 3);
  int at_q = 0, at_v = 0;
  for (Body& body : bodies) {
    body.parent = read.next(), body.root = read.next(), body.mocap = read.next();
    body.joints.resize(read.next());
    body.pose = read.pose();
    body.inertial = read.pose();
    read.next(body.inertia, 3);
    read.next(&body.mass, 1);
    for (Joint& joint : body.joints) {
      joint.type = read.next(), joint.qpos = at_q, joint.dof = at_v;
      read.next(joint.pos, 3);
      read.next(joint.axis, 3);
      read.next(&joint.zero, 1);
      at_q += joint.type == kFree ? 7 : joint.type == kBall ? 4 : 1;
      at_v += joint.dofs();
    }
    body.tree_mass = body.mass;
  }
  for (size_t b = bodies.size() - 1; b > 0; --b)
    bodies[bodies[b].parent].tree_mass += bodies[b].tree_mass;
  for (auto* attached : {&geoms, &sites})
    for (Attached& one : *attached) {
      one.body = read.next();
      one.pose = read.pose();
      read.next(one.size, 3);
    }
  int slots = 0;
  for (Pair& pair : pairs) {
    pair.kind = read.next(), pair.one = read.next(), pair.other = read.next();
    slots += pair.slots();
  }
  dist.resize(slots);
  point.resize(slots);
  frame.resize(slots);
  for (auto* of_body : {&pos, &center, &tree_center}) of_body->resize(bodies.size());
  for (auto* of_body : {&inertia, &composite}) of_body->resize(bodies.size());
  for (auto* of_body : {&velocity, &acceleration, &force}) of_body->resize(bodies.size());
  quat.resize(bodies.size());
  mat.resize(bodies.size());
  for (auto* of_dof : {&anchor, &axis}) of_dof->resize(nv);  // of a joint's first
  motion.resize(nv);
  bias.resize(nv), qvel.resize(nv), qpos.resize(nq);
  mocap_pos.resize(3 * num_mocap), mocap_quat.resize(4 * num_mocap);
  geom_pos.resize(geoms.size()), geom_mat.resize(geoms.size());
  site_pos.resize(sites.size()), site_mat.resize(sites.size());
}

void Block::load(const Given& given, const int* env) {
  ::load(given.qpos, nq, env, qpos.data());
  ::load(given.qvel, nv, env, qvel.data());
  ::load(given.mocap_pos, 3 * num_mocap, env, mocap_pos.data());
  ::load(given.mocap_quat, 4 * num_mocap, env, mocap_quat.data());
}

template <int N>
std::array<V, N> some(const std::vector<V>& of, int first) {
  std::array<V, N> out;
  std::copy_n(of.begin() + first, N, out.begin());
  return out;
}

// Position and rotation of a body, anchors and axes of its joints.
void Block::place(int b) {
  const Body& body = bodies[b];
  V3 at{};
  V4 turn{all(1.0f), V{}, V{}, V{}};
  if (body.mocap >= 0) {
    at = some<3>(mocap_pos, 3 * body.mocap);
    turn = unit(some<4>(mocap_quat, 4 * body.mocap));
  } else if (b) {
    at = pos[body.parent] + rotate(mat[body.parent], body.pose.pos);
    turn = quat[body.parent];
    if (body.pose.turned) turn = times_quat(turn, body.pose.quat);
  }
  V9 frame;
  to_matrix(turn, frame);
  for (const Joint& joint : body.joints) {
    if (joint.type == kFree) {
      at = some<3>(qpos, joint.qpos);
      turn = unit(some<4>(qpos, joint.qpos + 3));
      to_matrix(turn, frame);
      anchor[joint.dof] = at;
      continue;
    }
    anchor[joint.dof] = at + rotate(frame, joint.pos);
    axis[joint.dof] = rotate(frame, joint.axis);
    const V first = qpos[joint.qpos] - joint.zero;
    if (joint.type == kSlide) {
      for (int k = 0; k < 3; ++k) at[k] += axis[joint.dof][k] * first;
      continue;
    }
    const V4 by = joint.type == kHinge ? about(joint.axis, first)
                                       : unit(some<4>(qpos, joint.qpos));
    turn = times_quat(turn, by.data());
    to_matrix(turn, frame);
    at = anchor[joint.dof] - rotate(frame, joint.pos);
  }
  pos[b] = at, quat[b] = turn, mat[b] = frame;
  center[b] = at + rotate(frame, body.inertial.pos);
}

// Spatial inertia of a body about the centre of mass of its tree.
void Block::feel_inertia(int b) {
  const Body& body = bodies[b];
  const V9 turn = body.inertial.turned ? times(mat[b], body.inertial.mat) : mat[b];
  const V3 off = center[b] - tree_center[body.root];
  const V square = dot(off, off);
  constexpr int row[] = {0, 1, 2, 0, 0, 1}, column[] = {0, 1, 2, 1, 2, 2};
  V10& out = inertia[b];
  for (int n = 0; n < 6; ++n) {
    const int i = row[n], j = column[n];
    V sum = -off[i] * off[j] * body.mass;
    if (i == j) sum += square * body.mass;
    for (int k = 0; k < 3; ++k)
      sum += turn[3 * i + k] * turn[3 * j + k] * body.inertia[k];
    out[n] = sum;
  }
  for (int k = 0; k < 3; ++k) out[6 + k] = off[k] * body.mass;
  out[9] = all(body.mass);
}

// How a body moves with each of its degrees of freedom, about the same centre.
void Block::move_axes(int b) {
  const Body& body = bodies[b];
  for (const Joint& joint : body.joints) {
    int dof = joint.dof;
    if (joint.type == kSlide) {
      motion[dof] = {V{}, V{}, V{}, axis[dof][0], axis[dof][1], axis[dof][2]};
      continue;
    }
    const V3 offset = tree_center[body.root] - anchor[dof];
    if (joint.type == kFree)
      for (int k = 0; k < 3; ++k, ++dof) {
        motion[dof] = {};
        motion[dof][3 + k] = all(1.0f);
      }
    for (int k = 0; k < joint.turns(); ++k, ++dof) {
      V3 along = axis[joint.dof];
      if (joint.type != kHinge) along = {mat[b][k], mat[b][3 + k], mat[b][6 + k]};
      const V3 lever = cross(along.data(), offset.data());
      motion[dof] = {along[0], along[1], along[2], lever[0], lever[1], lever[2]};
    }
  }
}

// Forces of gravity, Coriolis and centrifugal accelerations: recursive Newton-Euler.
void Block::resist() {
  velocity[0] = {};
  acceleration[0] = {V{}, V{}, V{}, all(-gravity[0]), all(-gravity[1]), all(-gravity[2])};
  for (size_t b = 1; b < bodies.size(); ++b) {
    V6 v = velocity[bodies[b].parent], a = acceleration[bodies[b].parent];
    const auto faster = [&](int first, int count) {
      V6 sum{};
      for (int dof = first; dof < first + count; ++dof) {
        for (int k = 0; k < 6; ++k) sum[k] += motion[dof][k] * qvel[dof];
      }
      return sum;
    };
    for (const Joint& joint : bodies[b].joints) {
      int dof = joint.dof;
      if (joint.type == kFree) {
        const V6 along = faster(dof, 3);
        for (int k = 0; k < 6; ++k) v[k] += along[k];
        dof += 3;
      }
      const V6 own = faster(dof, joint.type == kFree ? 3 : joint.dofs());
      const V3 turned = cross(&v[0], &own[0]), carried = cross(&v[0], &own[3]),
               swept = cross(&v[3], &own[0]);
      for (int k = 0; k < 3; ++k) {
        a[k] += turned[k];
        a[3 + k] += carried[k] + swept[k];
      }
      for (int k = 0; k < 6; ++k) v[k] += own[k];
    }
    velocity[b] = v, acceleration[b] = a;
    V6 momentum;
    times_inertia(inertia[b].data(), a.data(), force[b].data());
    times_inertia(inertia[b].data(), v.data(), momentum.data());
    const V3 turned = cross(&v[0], &momentum[0]), swept = cross(&v[3], &momentum[3]),
             carried = cross(&v[0], &momentum[3]);
    for (int k = 0; k < 3; ++k) {
      force[b][k] += turned[k] + swept[k];
      force[b][3 + k] += carried[k];
    }
  }
  for (size_t b = bodies.size() - 1; b > 0; --b) {
    for (const Joint& joint : bodies[b].joints) {
      for (int dof = joint.dof; dof < joint.dof + joint.dofs(); ++dof) {
        bias[dof] = V{};
        for (int k = 0; k < 6; ++k) bias[dof] += motion[dof][k] * force[b][k];
      }
    }
    for (int k = 0; k < 6; ++k) force[bodies[b].parent][k] += force[b][k];
  }
}

void Block::compute(const Given& given, const int* env) {
  load(given, env);
  const int count = bodies.size();
  for (int b = 0; b < count; ++b) {
    place(b);
    for (int k = 0; k < 3; ++k) tree_center[b][k] = center[b][k] * bodies[b].mass;
  }
  for (int b = count - 1; b >= 0; --b) {
    const Body& body = bodies[b];
    if (b) tree_center[body.parent] = tree_center[body.parent] + tree_center[b];
    for (int k = 0; k < 3; ++k)
      tree_center[b][k] = body.tree_mass < kTiny ? center[b][k]
                                                 : tree_center[b][k] / body.tree_mass;
  }
  for (int b = 0; b < count; ++b) {
    feel_inertia(b);
    composite[b] = inertia[b];
    move_axes(b);
  }
  for (int b = count - 1; b > 0; --b)
    for (int k = 0; k < 10; ++k) composite[bodies[b].parent][k] += composite[b][k];
  composite[0] = {};
  force[0] = {};
  resist();
  attach(geoms, geom_pos, geom_mat);
  attach(sites, site_pos, site_mat);
  touch();
}

void Block::attach(const std::vector<Attached>& all, std::vector<V3>& at,
                   std::vector<V9>& turned) const {
  for (size_t i = 0; i < all.size(); ++i) {
    const V9& frame = mat[all[i].body];
    const Pose& pose = all[i].pose;
    at[i] = pos[all[i].body] + rotate(frame, pose.pos);
    turned[i] = pose.turned ? times(frame, pose.mat) : frame;
  }
}

void Block::touch() {
  int slot = 0;
  for (const Pair& pair : pairs) {
    const auto shape = [&](int g) { return Shape{geom_pos[g], geom_mat[g], geoms[g].size}; };
    const Shape a = shape(pair.one), b = shape(pair.other);
    Contact found[2];
    switch (pair.kind) {
      case kPlaneSphere: found[0] = plane_sphere(a, b.pos, b.size[0]); break;
      case kPlaneCapsule: plane_capsule(a, b, found); break;
      case kSphereSphere: found[0] = sphere_sphere(a.pos, a.size[0], b.pos, b.size[0]); break;
      case kSphereCapsule: found[0] = sphere_capsule(a, b); break;
      case kSphereBox: found[0] = sphere_box(a, b); break;
      case kCapsuleCapsule: found[0] = capsule_capsule(a, b); break;
      case kCapsuleBox: capsule_box(a, b, found); break;
    }
    for (int n = 0; n < pair.slots(); ++n, ++slot) {
      dist[slot] = found[n].dist;
      point[slot] = found[n].pos;
      frame[slot] = found[n].frame;
    }
  }
}

void Block::store(const Made& made, const int* env, int count) const {
  const auto put = [&](const auto& from, float* to) {
    if (!to) return;
    const int64_t size = from.size() * sizeof(from[0]) / sizeof(V);
    ::store(reinterpret_cast<const V*>(from.data()), size, env, count, to);
  };
  put(pos, made.pos);
  put(quat, made.quat);
  put(mat, made.mat);
  put(center, made.center);
  put(geom_pos, made.geom_pos);
  put(geom_mat, made.geom_mat);
  put(site_pos, made.site_pos);
  put(site_mat, made.site_mat);
  put(tree_center, made.tree_center);
  put(motion, made.motion);
  put(composite, made.inertia);
  put(bias, made.bias);
  put(dist, made.dist);
  put(point, made.point);
  put(frame, made.frame);
}

using Floats = ffi::Buffer<ffi::F32>;
using Result = ffi::ResultBuffer<ffi::F32>;

ffi::Error Kinematics(Floats qpos, Floats qvel, Floats mocap_pos, Floats mocap_quat,
                      Result pos, Result quat, Result mat, Result center,
                      Result geom_pos, Result geom_mat, Result site_pos,
                      Result site_mat, Result tree_center, Result motion,
                      Result inertia, Result bias, Result dist, Result point,
                      Result frame, ffi::Span<const int32_t> structure,
                      ffi::Span<const float> numbers) {
  const Given given{qpos.typed_data(), qvel.typed_data(), mocap_pos.typed_data(),
                    mocap_quat.typed_data()};
  const auto to = [](Result& made) {
    return made->element_count() ? made->typed_data() : nullptr;
  };
  const Made made{to(pos),      to(quat),     to(mat),         to(center), to(geom_pos),
                  to(geom_mat), to(site_pos), to(site_mat),    to(tree_center),
                  to(motion),   to(inertia),  to(bias),        to(dist),   to(point),
                  to(frame)};
  Block& block = kept<Block>(structure, numbers);
  for_each_block(qpos.element_count() / block.nq, [&](const int* env, int count) {
    block.compute(given, env);
    block.store(made, env, count);
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(dcc_kinematics, Kinematics,
                              ffi::Ffi::Bind()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Arg<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Ret<Floats>()
                                  .Attr<ffi::Span<const int32_t>>("structure")
                                  .Attr<ffi::Span<const float>>("numbers"));
