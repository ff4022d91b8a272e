// Surfels: disc samples of the scene's surfaces, the points of point-based GI.
#pragma once

#include <cstdint>
#include <vector>

#include "core/base/bulk_vector.h"
#include "core/math/vec.h"

namespace farpoint {

// Structure of arrays; all of one length. Positions are relative to the scene's origin.
struct SurfelCloud {
  BulkVector<Vec3f> position;
  BulkVector<Vec3f> normal;   // unit, geometric, by the winding: the front side
  BulkVector<float> area_m2;  // of the surface that the surfel stands for; sums to the scene's
  BulkVector<uint32_t> triangle;
  BulkVector<Vec2f> barycentric;  // weights of vertices 1 and 2

  size_t size() const { return position.size(); }
};

// Which sides of a surfel block light and carry it. A side that no one outside a closed object
// can see (it looks only at the object's own back faces) and that no light reaches would count as
// a second, dark layer behind the visible front: it is left out of the gather.
enum SurfelSide : uint8_t { kFrontVisible = 1, kBackVisible = 2 };

// SurfelSide bits of every surfel of a cloud.
using SurfelSides = std::vector<uint8_t>;

// What the surfels reflect. All of one length, parallel to a SurfelCloud.
struct SurfelShading {
  BulkVector<Rgb> front, back;  // reflected radiance, W/(m² sr), diffuse: the same all round
  SurfelSides visible_sides;    // those that are open, and those that a light reaches
  // What of it is not direct: irradiance after further bounces, W/m². Empty: one bounce.
  BulkVector<Rgb> indirect_front, indirect_back;
};

}  // namespace farpoint
