#include "core/scene/environment_image.h"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string_view>
#include <utility>
#include <vector>

#include "core/image/exr_io.h"
#include "core/math/elementary.h"
#include "core/scene/hdr_decode.h"

namespace farpoint {

namespace {

constexpr int64_t kMaxMapTexels = int64_t{1} << 26;
constexpr float kMaxRadiance = 1e15f;

bool StartsWith(std::span<const std::byte> bytes, std::string_view text) {
  if (bytes.size() < text.size()) return false;
  for (size_t i = 0; i < text.size(); ++i) {
    if (bytes[i] != static_cast<std::byte>(text[i])) return false;
  }
  return true;
}

}  // namespace

absl::Status LoadEnvironmentMap(const Blob& file, const std::string& name,
                                Environment& environment) {
  uint32_t width = 0, height = 0;
  std::vector<Rgb> texels;
  if (StartsWith(file.bytes(), "#?")) {
    FP_ASSIGN_OR_RETURN(HdrImage image, DecodeHdr(name, file.bytes(), kMaxMapTexels));
    width = image.width;
    height = image.height;
    texels = std::move(image.pixels);
  } else {
    FP_ASSIGN_OR_RETURN(ExrRgbImage image, ReadExrRgb(file.bytes(), name, kMaxMapTexels));
    if (image.cube_map) {
      return absl::InvalidArgumentError(
          "'" + name + "' is a cube map; write a lat-long map (OpenEXR's exrenvmap does)");
    }
    width = image.width;
    height = image.height;
    texels = std::move(image.pixels);
  }
  for (size_t i = 0; i < texels.size(); ++i) {
    Rgb& texel = texels[i];
    for (int c = 0; c < 3; ++c) {
      if (texel[c] <= 0) texel[c] = 0;  // also -0
      if (!(texel[c] <= kMaxRadiance)) {
        return absl::InvalidArgumentError(
            "'" + name + "': the pixel in column " + std::to_string(i % width) + ", row " +
            std::to_string(i / width) +
            (std::isfinite(texel[c]) ? " is beyond 1e15 W/(m² sr)" : " is not finite") +
            "; an environment map needs a radiance in every direction: correct it");
      }
    }
  }
  environment.map_width = width;
  environment.map_height = height;
  environment.map = std::move(texels);
  return absl::OkStatus();
}

absl::Status OrientEnvironmentMap(const Vec3d& up, double rotation_deg, Environment& environment) {
  const Vec3d y = NormalizeOr(up, Vec3d());
  if (!IsFinite(up) || y == Vec3d()) {
    return absl::InvalidArgumentError(
        "the environment map's up has no direction; give three numbers that are not all 0");
  }
  if (!std::isfinite(rotation_deg)) {
    return absl::InvalidArgumentError("the environment map's rotation is not a number of degrees");
  }
  // The smallest rotation from +y to y maps a to a + b x a + b x (b x a) / (1 + y.y), b = +y x y.
  Vec3d x(1, 0, 0), z(0, 0, 1);
  if (1.0 + y.y < 1e-12) {
    z = {0, 0, -1};
  } else {
    const Vec3d axis = Cross(Vec3d(0, 1, 0), y);
    const auto turn = [&](const Vec3d& a) {
      const Vec3d b = Cross(axis, a);
      return a + b + Cross(axis, b) / (1.0 + y.y);
    };
    x = Normalize(turn(x));
    z = Cross(x, y);
  }
  const SinCos r = DetSinCos(std::fmod(rotation_deg, 360.0) * (kPi / 180.0));
  // About +y, counter-clockwise from above: z turns towards x.
  const Vec3d x_turned = x * r.cos - z * r.sin;
  environment.world_from_map = {x_turned, y, Cross(x_turned, y)};
  return absl::OkStatus();
}

}  // namespace farpoint
