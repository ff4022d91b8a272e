#include "core/scene/gltf_animation.h"

#include <tiny_gltf.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "core/math/elementary.h"
#include "core/scene/gltf_accessor.h"

namespace farpoint {

namespace {

constexpr const char* kCorrect = "; correct the file or export it again";

bool IsMoved(const tinygltf::AnimationChannel& channel) {
  return channel.target_node >= 0 &&
         (channel.target_path == "translation" || channel.target_path == "rotation" ||
          channel.target_path == "scale" || channel.target_path == "weights");
}

std::string PlaceOf(size_t animation, int sampler) {
  return "/animations/" + std::to_string(animation) + "/samplers/" + std::to_string(sampler);
}

absl::StatusOr<std::vector<double>> ReadTimes(const tinygltf::Model& model, const std::string& name,
                                              size_t animation, int sampler_index) {
  const auto& sampler = model.animations[animation].samplers[static_cast<size_t>(sampler_index)];
  const AccessorReader reader(model, sampler.input);
  const auto fail = [&](const std::string& text) {
    return absl::InvalidArgumentError(name + ": " + PlaceOf(animation, sampler_index) +
                                      "/input: " + text + kCorrect);
  };
  if (!reader.SparseIndicesAreValid())
    return fail("the indices of its sparse accessor do not ascend");
  std::vector<double> times(reader.count());
  for (size_t i = 0; i < times.size(); ++i) {
    times[i] = reader.Get(i, 0);
    if (!std::isfinite(times[i]) || (i > 0 && !(times[i] > times[i - 1]))) {
      return fail("time " + std::to_string(i) + " is not finite or not after the one before it");
    }
  }
  return times;
}

// One sampler at one time.
class Curve {
 public:
  Curve(const tinygltf::Model& model, const tinygltf::AnimationSampler& sampler,
        const std::vector<double>& times, double time_s, size_t width)
      : values_(model, sampler.output),
        is_scalar_(model.accessors[static_cast<size_t>(sampler.output)].type ==
                   TINYGLTF_TYPE_SCALAR),
        is_cubic_(sampler.interpolation == "CUBICSPLINE"),
        is_step_(sampler.interpolation == "STEP"),
        width_(width) {
    const auto after = std::upper_bound(times.begin(), times.end(), time_s);
    const auto next = static_cast<size_t>(after - times.begin());
    if (next == 0 || next == times.size()) {  // clamped to the first or the last keyframe
      first_ = next == 0 ? 0 : times.size() - 1;
      second_ = first_;
      return;
    }
    first_ = next - 1;
    second_ = is_step_ ? first_ : next;
    span_s_ = times[next] - times[first_];
    t_ = (time_s - times[first_]) / span_s_;
  }

  bool IsValid() const { return values_.SparseIndicesAreValid(); }

  double Component(size_t c) const {
    const double a = Value(first_, c);
    if (first_ == second_) return a;
    const double b = Value(second_, c);
    const double t = t_;
    if (!is_cubic_) return a + (b - a) * t;
    // Hermite spline (glTF specification, appendix C): tangents are per second.
    const double out_tangent = span_s_ * Cubic(first_, 2, c);
    const double in_tangent = span_s_ * Cubic(second_, 0, c);
    const double t2 = t * t, t3 = t2 * t;
    return (2 * t3 - 3 * t2 + 1) * a + (t3 - 2 * t2 + t) * out_tangent + (3 * t2 - 2 * t3) * b +
           (t3 - t2) * in_tangent;
  }

  void Rotation(double (&out)[4]) const {
    double a[4], b[4];
    for (size_t c = 0; c < 4; ++c) {
      a[c] = Value(first_, c);
      b[c] = Value(second_, c);
    }
    if (is_cubic_ || first_ == second_) {
      for (size_t c = 0; c < 4; ++c) out[c] = Component(c);
    } else {
      Slerp(a, b, t_, out);
    }
  }

 private:
  // Element of the accessor, or `width_` elements of it per keyframe where they are scalars.
  double At(size_t element, size_t c) const {
    return is_scalar_ ? values_.Get(element * width_ + c, 0)
                      : values_.Get(element, static_cast<int>(c));
  }
  // Part 0: in-tangent, 1: value, 2: out-tangent.
  double Cubic(size_t key, size_t part, size_t c) const { return At(3 * key + part, c); }
  double Value(size_t key, size_t c) const { return is_cubic_ ? Cubic(key, 1, c) : At(key, c); }

  AccessorReader values_;
  bool is_scalar_, is_cubic_, is_step_;
  size_t width_;
  size_t first_ = 0, second_ = 0;
  double t_ = 0, span_s_ = 0;
};

}  // namespace

absl::StatusOr<std::optional<TimeRange>> AnimationRangeOf(const tinygltf::Model& model,
                                                          const std::string& name) {
  std::optional<TimeRange> range;
  for (size_t a = 0; a < model.animations.size(); ++a) {
    for (const auto& channel : model.animations[a].channels) {
      if (!IsMoved(channel)) continue;
      FP_ASSIGN_OR_RETURN(const auto times, ReadTimes(model, name, a, channel.sampler));
      if (!range) range = TimeRange{times.front(), times.back()};
      range->begin_s = std::min(range->begin_s, times.front());
      range->end_s = std::max(range->end_s, times.back());
    }
  }
  return range;
}

absl::Status ApplyAnimations(double time_s, const std::string& name, tinygltf::Model& model) {
  for (size_t a = 0; a < model.animations.size(); ++a) {
    for (const auto& channel : model.animations[a].channels) {
      if (!IsMoved(channel)) continue;
      tinygltf::Node& node = model.nodes[static_cast<size_t>(channel.target_node)];
      const auto fail = [&](const std::string& text) {
        return absl::InvalidArgumentError(name + ": " + PlaceOf(a, channel.sampler) + ": " + text +
                                          kCorrect);
      };
      FP_ASSIGN_OR_RETURN(const auto times, ReadTimes(model, name, a, channel.sampler));
      const std::string& path = channel.target_path;
      size_t width = path == "rotation" ? 4 : 3;
      if (path == "weights") {
        const auto& mesh = model.meshes[static_cast<size_t>(node.mesh)];
        width = mesh.primitives.front().targets.size();
      } else if (!node.matrix.empty()) {
        return absl::InvalidArgumentError(
            name + ": /nodes/" + std::to_string(channel.target_node) +
            "/matrix: an animation moves this node, which takes translation, rotation and scale "
            "instead of a matrix" +
            kCorrect);
      }
      const auto& sampler = model.animations[a].samplers[static_cast<size_t>(channel.sampler)];
      const Curve curve(model, sampler, times, time_s, width);
      if (!curve.IsValid()) return fail("the indices of its sparse accessor do not ascend");
      std::vector<double> values(width);
      if (path == "rotation") {
        double rotation[4];
        curve.Rotation(rotation);
        values.assign(rotation, rotation + 4);
      } else {
        for (size_t c = 0; c < width; ++c) values[c] = curve.Component(c);
      }
      for (const double value : values) {
        if (!std::isfinite(value)) return fail("its output at this time is not finite");
      }
      if (path == "translation") node.translation = values;
      if (path == "rotation") node.rotation = values;
      if (path == "scale") node.scale = values;
      if (path == "weights") node.weights = values;
    }
  }
  return absl::OkStatus();
}

Affine RotationOf(const double (&quaternion)[4]) {
  Affine m;
  double x = quaternion[0], y = quaternion[1], z = quaternion[2], w = quaternion[3];
  const double length = std::sqrt(x * x + y * y + z * z + w * w);
  if (!(length > 0) || !std::isfinite(length)) return m;
  x /= length, y /= length, z /= length, w /= length;
  m.column[0] = {1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)};
  m.column[1] = {2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)};
  m.column[2] = {2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)};
  return m;
}

void Slerp(const double (&a)[4], const double (&b)[4], double t, double (&out)[4]) {
  double dot = 0;
  for (int c = 0; c < 4; ++c) dot += a[c] * b[c];
  const double sign = dot < 0 ? -1 : 1;
  double weight_a = 1 - t, weight_b = t;
  // Nearly parallel: the chord is the arc, and its sine would cancel.
  if (std::fabs(dot) < 1 - 1e-9) {
    const double angle = DetAcos(std::fabs(dot));
    const double sine = DetSinCos(angle).sin;
    weight_a = DetSinCos((1 - t) * angle).sin / sine;
    weight_b = DetSinCos(t * angle).sin / sine;
  }
  for (int c = 0; c < 4; ++c) out[c] = weight_a * a[c] + sign * weight_b * b[c];
}

}  // namespace farpoint
