#include "core/scene/gltf_deform.h"

#include <tiny_gltf.h>

#include <cmath>
#include <utility>

#include "core/scene/gltf_accessor.h"
#include "core/scene/polygon.h"

namespace farpoint {

namespace {

absl::Status Fail(const std::string& place, const std::string& text) {
  return absl::InvalidArgumentError(place + ": " + text + "; correct the file or export it again");
}

absl::Status CheckSparse(const AccessorReader& reader, const std::string& place) {
  if (reader.SparseIndicesAreValid()) return absl::OkStatus();
  return Fail(place, "the indices of its sparse accessor do not ascend inside of the accessor");
}

absl::Status Morph(const tinygltf::Model& model, const tinygltf::Primitive& primitive,
                   const std::vector<uint32_t>& vertices, const std::vector<double>& weights,
                   const std::string& place, std::vector<Vec3d>& positions,
                   std::vector<Vec3d>& normals) {
  for (size_t t = 0; t < primitive.targets.size() && t < weights.size(); ++t) {
    if (weights[t] == 0) continue;
    const auto add = [&](const char* name, std::vector<Vec3d>& values) -> absl::Status {
      const auto it = primitive.targets[t].find(name);
      if (it == primitive.targets[t].end()) return absl::OkStatus();
      const AccessorReader deltas(model, it->second);
      FP_RETURN_IF_ERROR(CheckSparse(deltas, place + "/targets/" + std::to_string(t) + "/" + name));
      for (size_t v = 0; v < values.size(); ++v) {
        values[v] += deltas.Get3d(vertices[v]) * weights[t];
      }
      return absl::OkStatus();
    };
    FP_RETURN_IF_ERROR(add("POSITION", positions));
    FP_RETURN_IF_ERROR(add("NORMAL", normals));
  }
  return absl::OkStatus();
}

// Up to four joints of each vertex in each set.
struct JointSet {
  AccessorReader joints, weights;
};

void AddScaled(const Affine& m, double weight, Affine& sum) {
  for (int c = 0; c < 3; ++c) sum.column[c] += m.column[c] * weight;
  sum.translation += m.translation * weight;
}

absl::Status Skin(const tinygltf::Model& model, const tinygltf::Primitive& primitive,
                  const std::vector<uint32_t>& vertices, const std::vector<Affine>& world_from_bind,
                  const std::string& place, std::vector<Vec3d>& positions,
                  std::vector<Vec3d>& normals) {
  std::vector<JointSet> sets;
  for (size_t set = 0;; ++set) {
    const std::string suffix = std::to_string(set);
    const auto joints = primitive.attributes.find("JOINTS_" + suffix);
    const auto weights = primitive.attributes.find("WEIGHTS_" + suffix);
    if (joints == primitive.attributes.end() || weights == primitive.attributes.end()) break;
    sets.push_back({AccessorReader(model, joints->second), AccessorReader(model, weights->second)});
    FP_RETURN_IF_ERROR(CheckSparse(sets.back().joints, place + "/attributes/JOINTS_" + suffix));
    FP_RETURN_IF_ERROR(CheckSparse(sets.back().weights, place + "/attributes/WEIGHTS_" + suffix));
  }
  constexpr Affine kZero{{{}, {}, {}}, {}};
  for (size_t v = 0; v < positions.size(); ++v) {
    Affine blend = kZero;
    double sum = 0;
    for (const JointSet& set : sets) {
      for (int k = 0; k < 4; ++k) {
        const double weight = set.weights.Get(vertices[v], k);
        if (!(weight >= 0) || !std::isfinite(weight)) {
          return Fail(place, "the weight of a joint of vertex " + std::to_string(vertices[v]) +
                                 " is negative or not finite");
        }
        if (weight == 0) continue;
        const auto joint = static_cast<size_t>(set.joints.Get(vertices[v], k));
        if (joint >= world_from_bind.size()) {
          return Fail(place, "joint " + std::to_string(joint) + " of vertex " +
                                 std::to_string(vertices[v]) + " is beyond the " +
                                 std::to_string(world_from_bind.size()) + " joints of the skin");
        }
        AddScaled(world_from_bind[joint], weight, blend);
        sum += weight;
      }
    }
    if (sum > 0) {
      const double inverse = 1 / sum;
      for (Vec3d& column : blend.column) column *= inverse;
      blend.translation *= inverse;
    } else {
      blend = world_from_bind[0];
    }
    positions[v] = blend.Point(positions[v]);
    if (!normals.empty()) normals[v] = blend.Normal(normals[v]);
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<DeformedMesh> DeformMesh(const tinygltf::Model& model,
                                        const tinygltf::Primitive& primitive, const Mesh& base,
                                        const std::vector<uint32_t>& vertices,
                                        const Deformation& deformation, const std::string& place) {
  std::vector<Vec3d> positions(base.positions.begin(), base.positions.end());
  std::vector<Vec3d> normals(base.normals.begin(), base.normals.end());
  FP_RETURN_IF_ERROR(
      Morph(model, primitive, vertices, deformation.weights, place, positions, normals));
  DeformedMesh result;
  if (!deformation.world_from_bind.empty()) {
    FP_RETURN_IF_ERROR(
        Skin(model, primitive, vertices, deformation.world_from_bind, place, positions, normals));
    Box3d bounds;
    for (const Vec3d& p : positions) bounds.Extend(p);
    result.in_world = true;
    result.world_offset = OffsetFor(bounds);
  }
  result.mesh = base;
  for (size_t v = 0; v < positions.size(); ++v) {
    const Vec3f p(positions[v] - result.world_offset);
    if (!IsFinite(p)) {
      return Fail(place, "vertex " + std::to_string(vertices[v]) +
                             " is moved to a place that is not finite");
    }
    result.mesh.positions[v] = p;
  }
  for (size_t v = 0; v < normals.size(); ++v) {
    result.mesh.normals[v] = Vec3f(NormalizeOr(normals[v], Vec3d()));
  }
  return result;
}

}  // namespace farpoint
