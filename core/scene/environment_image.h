// Environment maps from files: a lat-long image of what surrounds the scene, as Environment
// (core/scene/scene.h) holds it. Functions are thread-safe.
#pragma once

#include <string>

#include "core/base/blob.h"
#include "core/base/status.h"
#include "core/math/vec.h"
#include "core/scene/scene.h"

namespace farpoint {

// Sets the map of `environment`; sky and orientation stay as they are. `file` is an OpenEXR file
// (R, G, B or Y alone; half or float; the dataWindow is the map, wherever it lies; other primaries
// than Rec. 709 are converted) or a Radiance picture (.hdr), told apart by their first bytes. A map
// has up to 2^26 texels. Negative values, which resampling leaves behind, become 0; a value that is
// not finite or beyond 1e15 W/(m² sr) is refused: what is seen there is unknown.
// kInvalidArgument, kDataLoss or kResourceExhausted say what is wrong with the file `name`, where
// and what to do; `environment` is then as it was.
absl::Status LoadEnvironmentMap(const Blob& file, const std::string& name,
                                Environment& environment);

// Turns the map: its up (the top row) points to `up`, of any length, world; it is then turned about
// `up` by `rotation_deg`, counter-clockwise if one looks down from `up`. With up = (0, 1, 0) and no
// rotation the map's frame is the world's; with another up it is that frame after the smallest
// rotation that brings +y to `up` (about +x if `up` is -y). kInvalidArgument if `up` has no
// direction or a value is not finite.
absl::Status OrientEnvironmentMap(const Vec3d& up, double rotation_deg, Environment& environment);

}  // namespace farpoint
