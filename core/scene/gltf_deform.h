// Morph targets and skins of glTF meshes. For core/scene's glTF files only.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/base/status.h"
#include "core/math/affine.h"
#include "core/scene/scene.h"

namespace tinygltf {
class Model;
struct Primitive;
}  // namespace tinygltf

namespace farpoint {

struct Deformation {
  std::vector<double> weights;          // of the morph targets; missing ones are 0
  std::vector<Affine> world_from_bind;  // by joint of the skin; empty: no skin
};

struct DeformedMesh {
  Mesh mesh;
  // Without a skin the mesh stays in its node's frame; with one it lies in the world, about
  // `world_offset`.
  bool in_world = false;
  Vec3d world_offset;
};

// `base` as the deformation moves it. `vertices` has the primitive's vertex of each of the mesh's.
// Weights of joints are scaled to a sum of 1; a vertex without any stays with joint 0. `place`
// ("scene.gltf: /meshes/0/primitives/0") stands in the messages: kInvalidArgument for joints beyond
// the skin, for values that are not finite and for sparse indices that do not ascend.
absl::StatusOr<DeformedMesh> DeformMesh(const tinygltf::Model& model,
                                        const tinygltf::Primitive& primitive, const Mesh& base,
                                        const std::vector<uint32_t>& vertices,
                                        const Deformation& deformation, const std::string& place);

}  // namespace farpoint
