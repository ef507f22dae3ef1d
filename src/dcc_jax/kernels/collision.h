// Where two geoms touch. The algorithms are those of MJX, which are the reference.

#pragma once

#include "lanes.h"
#include "spatial.h"

struct Shape {
  const V3& pos;
  const V9& mat;
  const float* size;

  V3 axis() const { return {mat[2], mat[5], mat[8]}; }
};

// `dist` is negative in contact; `frame` has the normal and two tangents in its rows. Of
// geoms that are apart `dist` is positive, and the rest means nothing.
struct Contact {
  V dist;
  V3 pos;
  V9 frame;
};

inline V9 framed(const V3& normal) {
  const V3 a = unit(normal);
  const I sideways = (a[1] > -0.5f) & (a[1] < 0.5f);
  V3 b{V{}, choose(sideways, all(1.0f), V{}), choose(sideways, V{}, all(1.0f))};
  b = unit(b - dot(a, b) * a);
  const V3 c = cross(a, b);
  return {a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]};
}

inline Contact plane_sphere(const Shape& plane, const V3& pos, float radius) {
  const V3 normal = plane.axis();
  const V dist = dot(pos - plane.pos, normal) - radius;
  return {dist, pos - (radius + 0.5f * dist) * normal, framed(normal)};
}

// Two contacts, whose frames are aligned with the capsule.
inline void plane_capsule(const Shape& plane, const Shape& capsule, Contact* out) {
  const V3 normal = plane.axis(), axis = capsule.axis();
  V3 along = axis - dot(normal, axis) * normal;
  const V length = square_root(dot(along, along));
  const I upright = length < 0.5f, sideways = (normal[1] > -0.5f) & (normal[1] < 0.5f);
  along = unit(along);
  along = {choose(upright, V{}, along[0]),
           choose(upright, choose(sideways, all(1.0f), V{}), along[1]),
           choose(upright, choose(sideways, V{}, all(1.0f)), along[2])};
  const V3 across = cross(normal, along);
  for (int end = 0; end < 2; ++end) {
    const float reach = end ? -capsule.size[1] : capsule.size[1];
    out[end] = plane_sphere(plane, capsule.pos + reach * axis, capsule.size[0]);
    out[end].frame = {normal[0], normal[1], normal[2], along[0], along[1],
                      along[2],  across[0], across[1], across[2]};
  }
}

inline Contact sphere_sphere(const V3& one, float radius, const V3& other,
                             float other_radius) {
  V3 normal = other - one;
  const V length = square_root(dot(normal, normal));
  normal = unit(normal);
  normal[0] = choose(length == 0.0f, all(1.0f), normal[0]);
  const V dist = length - (radius + other_radius);
  return {dist, one + (radius + 0.5f * dist) * normal, framed(normal)};
}

inline V3 closest_on_segment(const V3& a, const V3& b, const V3& point) {
  const V3 along = b - a;
  const V t = dot(point - a, along) / (dot(along, along) + 1e-6f);
  return a + clamp(t, all(0.0f), all(1.0f)) * along;
}

inline Contact sphere_capsule(const Shape& sphere, const Shape& capsule) {
  const V3 reach = capsule.size[1] * capsule.axis();
  const V3 on = closest_on_segment(capsule.pos - reach, capsule.pos + reach, sphere.pos);
  return sphere_sphere(sphere.pos, sphere.size[0], on, capsule.size[0]);
}

// The closest points of two segments.
inline void closest_of_segments(const V3& a0, const V3& a1, const V3& b0, const V3& b1,
                                V3& on_a, V3& on_b) {
  const V3 along_a = a1 - a0, along_b = b1 - b0;
  const V half_a = 0.5f * square_root(dot(along_a, along_a));
  const V half_b = 0.5f * square_root(dot(along_b, along_b));
  const V3 dir_a = unit(along_a), dir_b = unit(along_b);
  const V3 mid_a = a0 + half_a * dir_a, mid_b = b0 + half_b * dir_b;
  const V3 between = mid_a - mid_b;
  const V both = dot(dir_a, dir_b), a_way = dot(dir_a, between),
          b_way = dot(dir_b, between);
  const V t_a = (both * b_way - a_way) / (1.0f - both * both + 1e-6f);
  const V t_b = b_way + t_a * both;
  on_a = mid_a + clamp(t_a, -half_a, half_a) * dir_a;
  on_b = mid_b + clamp(t_b, -half_b, half_b) * dir_b;
  // Where both ends are reached, one of them may be closer to somewhere else.
  const V3 again_a = closest_on_segment(a0, a1, on_b);
  const V3 again_b = closest_on_segment(b0, b1, on_a);
  const V3 off_a = on_b - again_a, off_b = on_a - again_b;
  const I first = dot(off_a, off_a) < dot(off_b, off_b);
  on_b = choose(first, on_b, again_b);
  on_a = choose(first, again_a, on_a);
}

inline Contact capsule_capsule(const Shape& one, const Shape& other) {
  const V3 reach = one.size[1] * one.axis(), across = other.size[1] * other.axis();
  V3 on_one, on_other;
  closest_of_segments(one.pos - reach, one.pos + reach, other.pos - across,
                      other.pos + across, on_one, on_other);
  return sphere_sphere(on_one, one.size[0], on_other, other.size[0]);
}

inline Contact sphere_box(const Shape& sphere, const Shape& box) {
  const V3 at = rotate_back(box.mat, sphere.pos - box.pos);
  const float radius = sphere.size[0];
  // The face that the centre is farthest in front of, or least behind.
  V best = all(-1e12f);
  V3 normal{}, on = at;
  for (int k = 0; k < 3; ++k) {
    const V side = sign(at[k]), front = at[k] * side - box.size[k];
    const I better = front > best;
    best = choose(better, front, best);
    for (int i = 0; i < 3; ++i)
      normal[i] = choose(better, i == k ? side : V{}, normal[i]);
  }
  I inside = ~I{};
  for (int k = 0; k < 3; ++k) {
    const I on_axis = normal[k] != 0.0f;
    const V half = all(box.size[k]);
    on[k] = choose(on_axis, normal[k] * half, clamp(at[k], -half, half));
    inside &= on_axis | ((at[k] <= half) & (at[k] >= -half));
  }
  const V3 way = on - at;
  V length = square_root(dot(way, way));
  V3 towards = unit(way);
  const V turn = choose(dot(on, towards) > 0.0f, all(-1.0f), all(1.0f));
  const I face = inside | (length < 1e-6f);
  V3 n = choose(face, -1.0f * normal, turn * towards);
  length *= turn;
  const V dist = choose(best >= radius, all(1.0f), length - radius);
  const V3 middle = 0.5f * (on + at + radius * n);
  return {dist, box.pos + rotate(box.mat, middle.data()), framed(rotate(box.mat, n.data()))};
}

// Two contacts: of the capsule with a face, of which the first may be one with an edge.
inline void capsule_box(const Shape& capsule, const Shape& box, Contact* out) {
  const float radius = capsule.size[0];
  const float* half = box.size;
  const V3 middle = rotate_back(box.mat, capsule.pos - box.pos);
  const V3 reach = capsule.size[1] * rotate_back(box.mat, capsule.axis());
  const V3 end[2] = {middle - reach, middle + reach};
  // The face with the least penetration.
  V best = all(-1e12f);
  V3 normal{};
  for (int k = 0; k < 3; ++k)
    for (float side : {1.0f, -1.0f}) {
      const V low = choose(side * end[0][k] < side * end[1][k], side * end[0][k],
                           side * end[1][k]);
      const V support = low - half[k] - radius;
      const I better = support > best;
      best = choose(better, support, best);
      for (int i = 0; i < 3; ++i)
        normal[i] = choose(better, all(i == k ? side : 0.0f), normal[i]);
    }
  const I close = best < 0.0f;
  const Contact apart{all(1.0f), box.pos, framed(box.axis())};
  out[0] = out[1] = apart;
  if (!any(close)) return;
  // The capsule's axis, clipped to what is in front of that face.
  const V3 along = end[1] - end[0];
  V from = V{}, until = all(1.0f);
  I beside{};
  for (int k = 0; k < 3; ++k)
    for (float side : {1.0f, -1.0f}) {
      const I counts = normal[k] == 0.0f;
      const V slope = side * along[k], start = side * end[0][k] - half[k];
      const V t = clamp(-start / choose(slope == 0.0f, all(1e-6f), slope), all(0.0f),
                        all(1.0f));
      const I first = counts & (start > 1e-6f), last = counts & (start + slope > 1e-6f);
      from = choose(first & (t > from), t, from);
      until = choose(last & (t < until), t, until);
      beside |= first & last;
    }
  beside |= until < from;
  V face[2];
  V3 pos[2], n[2];
  for (int c = 0; c < 2; ++c) {
    const V3 tip = end[0] + (c ? until : from) * along - radius * normal;
    V depth = V{};
    for (int k = 0; k < 3; ++k) depth += normal[k] * (normal[k] * half[k] - tip[k]);
    pos[c] = tip + (0.5f * depth) * normal;
    n[c] = -1.0f * normal;
    face[c] = choose(close & ~beside, depth, all(-1.0f));
  }
  // The closest of the twelve edges.
  V nearest = all(1e12f);
  V3 on_edge{}, on_axis{}, outward{};
  for (int k = 0; k < 3; ++k)
    for (float one : {1.0f, -1.0f})
      for (float other : {1.0f, -1.0f}) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        V3 a, b, at, on;
        a[i] = b[i] = all(one * half[i]);
        a[j] = b[j] = all(other * half[j]);
        a[k] = all(-half[k]);
        b[k] = all(half[k]);
        closest_of_segments(a, b, end[0], end[1], at, on);
        const V3 way = at - on;
        const V length = square_root(dot(way, way));
        const I better = length < nearest;
        nearest = choose(better, length, nearest);
        on_edge = choose(better, at, on_edge);
        on_axis = choose(better, on, on_axis);
        outward[i] = choose(better, all(one), outward[i]);
        outward[j] = choose(better, all(other), outward[j]);
        outward[k] = choose(better, V{}, outward[k]);
      }
  const V3 towards = unit(on_edge - on_axis);
  I edge = nearest * nearest >= 1e-6f;
  for (int k = 0; k < 3; ++k)
    edge &= (outward[k] == 0.0f) | (outward[k] * towards[k] < 0.0f);
  const V depth = radius - nearest, flat = dot(towards, normal);
  const V least = choose(face[0] < face[1], face[0], face[1]);
  edge &= (depth > 0.0f) & ((least <= 0.0f) | (depth < least));
  edge &= (flat <= 0.99f) & (flat >= -0.99f);
  pos[0] = choose(edge, 0.5f * (on_edge + on_axis + radius * towards), pos[0]);
  n[0] = choose(edge, towards, n[0]);
  face[0] = choose(edge, depth, face[0]);
  face[1] = choose(edge, all(-1.0f), face[1]);
  for (int c = 0; c < 2; ++c) {
    const V3 at = box.pos + rotate(box.mat, pos[c].data());
    const V9 frame = framed(rotate(box.mat, n[c].data()));
    out[c].dist = choose(close, -face[c], apart.dist);
    out[c].pos = choose(close, at, apart.pos);
    for (int i = 0; i < 9; ++i) out[c].frame[i] = choose(close, frame[i], apart.frame[i]);
  }
}
