// What importers share about meshes: polygons to triangles, corners to vertices, colours of
// vertices.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "core/math/vec.h"
#include "core/scene/scene.h"

namespace farpoint {

// Faces with more corners are refused by the importers; bounds the time that one takes.
inline constexpr size_t kMaxPolygonCorners = 10'000;

// Cuts a polygon of n >= 3 corners into n - 2 triangles of the same winding, appended to
// `triangles` as indices into `corners`. The polygon may be concave and need not be quite planar;
// it is seen along its mean normal (Newell's). A quadrilateral is cut along its shorter diagonal
// that lies inside. Deterministic. Takes time O(n²) at most. False if the polygon crosses itself
// or has no area, so that the triangles may overlap.
bool TriangulatePolygon(std::span<const Vec3d> corners,
                        std::vector<std::array<uint32_t, 3>>& triangles);

// A corner of a face in formats that number positions, texture coordinates and normals apart.
struct MeshCorner {
  static constexpr uint32_t kNone = std::numeric_limits<uint32_t>::max();
  uint32_t position = 0, uv = kNone, normal = kNone;
  bool operator==(const MeshCorner&) const = default;
};

// Numbers distinct corners in the order of their first appearance.
class CornerIndex {
 public:
  explicit CornerIndex(size_t expected_corners);
  // The corner's vertex; a new one if it was not seen yet. At most 2^32 - 1 corners.
  uint32_t VertexOf(const MeshCorner& corner);
  const std::vector<MeshCorner>& corners() const { return corners_; }

 private:
  void Grow();

  std::vector<MeshCorner> corners_;
  std::vector<uint32_t> slots_;  // index into corners_; kNone: free. A power of two.
};

// The mean of linear colours over the mesh's surface; `colors` has one per position. The mean over
// the vertices if the mesh has no area.
Rgb MeanColor(const Mesh& mesh, std::span<const Rgb> colors);

// Appends a plain material of that colour, linear, clamped to [0, 1], and returns its index; an
// equal one that was appended last is taken again.
int32_t AddColorMaterial(const Rgb& color, Scene& scene);

// Where coordinates of such bounds are stored as floats: relative to their centre if they lie so
// far from zero that floats would lose their detail, else to zero.
Vec3d OffsetFor(const Box3d& bounds);

}  // namespace farpoint
