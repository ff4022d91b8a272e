// Animations of a glTF file, evaluated at a time. For core/scene's glTF files only; what is read
// here has passed CheckGltf.
#pragma once

#include <optional>
#include <string>

#include "core/base/status.h"
#include "core/math/affine.h"
#include "core/scene/importer.h"

namespace tinygltf {
class Model;
}

namespace farpoint {

// From the first to the last keyframe of all animations that move a node; nothing if there is
// none. `name` stands in the messages. kInvalidArgument for times that do not ascend or are not
// finite.
absl::StatusOr<std::optional<TimeRange>> AnimationRangeOf(const tinygltf::Model& model,
                                                          const std::string& name);

// Sets translation, rotation, scale and weights of the nodes to what all animations together give
// them at `time_s`, each clamped to its own keyframes. Where two animations move the same property
// of a node, the later one in the file wins. kInvalidArgument as above, for values that are not
// finite, and for a node with a matrix.
absl::Status ApplyAnimations(double time_s, const std::string& name, tinygltf::Model& model);

// A rotation by a quaternion (x, y, z, w), normalised first; none if it is zero or not finite.
Affine RotationOf(const double (&quaternion)[4]);

// Between two unit quaternions along the shorter arc (glTF specification, appendix C).
void Slerp(const double (&a)[4], const double (&b)[4], double t, double (&out)[4]);

}  // namespace farpoint
