// What LoadedScene holds; for core/render only.
#pragma once

#include <memory>
#include <mutex>

#include "core/accel/ray_accel.h"
#include "core/light/light_sampler.h"
#include "core/pbgi/point_tree.h"
#include "core/pbgi/surfel_atlas.h"
#include "core/render/frame_renderer.h"

namespace farpoint {

class LoadedSceneData final : public LoadedScene {
 public:
  std::shared_ptr<const PreparedScene> scene;
  std::shared_ptr<const RayAccel> accel;
  std::unique_ptr<const LightSampler> lights;
  std::shared_ptr<const PointTree> tree;  // null if the blobs have none

  // Made when it is first asked for; `tree` must be there.
  const SurfelAtlas& Atlas() const {
    std::call_once(atlas_once_, [this] { atlas_ = std::make_unique<SurfelAtlas>(*accel, *tree); });
    return *atlas_;
  }
  // The same of what further bounces bring. Null: the tree has one bounce.
  const SurfelAtlas* IndirectAtlas() const {
    if (!tree->has_indirect()) return nullptr;
    std::call_once(indirect_once_,
                   [this] { indirect_ = std::make_unique<SurfelAtlas>(*accel, *tree, &Atlas()); });
    return indirect_.get();
  }

 private:
  mutable std::once_flag atlas_once_, indirect_once_;
  mutable std::unique_ptr<const SurfelAtlas> atlas_, indirect_;
};

}  // namespace farpoint
