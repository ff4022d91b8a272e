// One object in a frame of its own: what decides where its surfels lie, and nothing else.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "core/base/hash.h"
#include "core/scene/prepared_scene.h"
#include "core/scene/scene.h"

namespace farpoint {

// The kept triangles of one object, made from the mesh and the linear part of the instance's
// transform, without its translation, its size and (but for stretched instances, below) its
// rotation. So an object that is moved, turned, or scaled alike along all axes has the same shape
// bit by bit, wherever the scene's origin lies.
//
// The frame is that of the symmetric factor of the polar decomposition of the linear part, rounded
// to 20 bits, so that the rounding errors of a rotation vanish: lengths agree with the world's
// within 2^-16. An instance that is stretched by more than 16 : 1 keeps its linear part as it is:
// then a rotation gives another shape.
struct ObjectShape {
  std::vector<Vec3f> vertices;                     // in units; 0 where no kept triangle uses it
  std::vector<std::array<uint32_t, 3>> triangles;  // in the prepared scene's order and winding
  std::vector<float> areas;                        // of the triangles, units²
  double unit_m = 1;                               // metres per unit
  double area = 0;                                 // units²; the sum of `areas`
  Digest digest;                                   // of vertices and triangles

  double area_m2() const { return area * unit_m * unit_m; }
};

// The shape of object `object` of `prepared`, which Prepare made from `scene` (not FromBlob).
ObjectShape MakeObjectShape(const Scene& scene, const PreparedScene& prepared, size_t object,
                            uint32_t first_vertex);

// By object: 1 if it lies where an earlier one without holes does, triangle for triangle to the
// last bit. Light sees one of the two only; surfels of both would block and shine twice.
std::vector<uint8_t> RepeatedObjects(const PreparedScene& prepared, Executor& executor);

// The shapes of all objects, in parallel.
std::vector<ObjectShape> MakeObjectShapes(const Scene& scene, const PreparedScene& prepared,
                                          Executor& executor);

struct SurfaceSize {
  double area_m2 = 0;     // of all objects, summed in their order
  double largest_m2 = 0;  // of the object that has most
};
// Without those that are repeated.
SurfaceSize SizeOf(const std::vector<ObjectShape>& shapes, const std::vector<uint8_t>& repeated);

}  // namespace farpoint
