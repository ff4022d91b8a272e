// What LoadedScene holds; for core/render only.
#pragma once

#include <memory>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/point_tree.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

class LoadedSceneData final : public LoadedScene {
 public:
  std::shared_ptr<const PreparedScene> scene;
  std::shared_ptr<const RayAccel> accel;
  std::unique_ptr<const LightSampler> lights;
  std::shared_ptr<const PointTree> tree;  // null if the blobs have none
};

}  // namespace farpoint
