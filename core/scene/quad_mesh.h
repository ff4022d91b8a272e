// Meshes of quadrilaterals and plain materials, for scenes that are made by code.
#pragma once

#include <array>
#include <string>
#include <string_view>
#include <vector>

#include "core/scene/scene.h"

namespace farpoint {

// Four corners in order about the quad; the front is where that order is counter-clockwise. Cut
// into the triangles 0 1 2 and 0 2 3.
using Quad = std::array<Vec3f, 4>;

// Each quad has four vertices of its own. `material` is an index into Scene::materials.
Mesh MeshOfQuads(std::string_view name, int32_t material, const std::vector<Quad>& quads);

// The mesh, and an instance of it at the origin, both called `name`.
void AddQuads(std::string_view name, int32_t material, const std::vector<Quad>& quads,
              Scene& scene);

// Lambert: albedo in [0, 1], emission in W/(m² sr).
Material LambertMaterial(std::string_view name, const Rgb& albedo, const Rgb& emission = {});

}  // namespace farpoint
