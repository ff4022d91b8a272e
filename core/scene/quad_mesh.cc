#include "core/scene/quad_mesh.h"

#include <utility>

namespace farpoint {

Mesh MeshOfQuads(std::string_view name, int32_t material, const std::vector<Quad>& quads) {
  Mesh mesh;
  mesh.name = name;
  mesh.material = material;
  for (const Quad& quad : quads) {
    const auto first = static_cast<uint32_t>(mesh.positions.size());
    mesh.positions.insert(mesh.positions.end(), quad.begin(), quad.end());
    mesh.triangles.push_back({first, first + 1, first + 2});
    mesh.triangles.push_back({first, first + 2, first + 3});
  }
  return mesh;
}

void AddQuads(std::string_view name, int32_t material, const std::vector<Quad>& quads,
              Scene& scene) {
  scene.instances.push_back({std::string(name), static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(MeshOfQuads(name, material, quads));
}

Material LambertMaterial(std::string_view name, const Rgb& albedo, const Rgb& emission) {
  Material material;
  material.name = name;
  material.base_color = albedo;
  material.emission = emission;
  material.metallic = 0;
  return material;
}

}  // namespace farpoint
