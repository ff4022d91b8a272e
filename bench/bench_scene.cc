#include "bench/bench_scene.h"

#include <utility>

#include "core/scene/asset.h"
#include "core/scene/importer.h"
#include "core/scene/procedural.h"

namespace farpoint {

namespace {

constexpr unsigned kCityBlocks = 4, kSmallCityBlocks = 2;
constexpr uint64_t kCitySeed = 1;

}  // namespace

absl::StatusOr<BenchScene> MakeBenchScene(const std::string& name_or_path, bool small) {
  if (name_or_path == "cornell") return BenchScene{MakeCornellBox(), {}};
  if (name_or_path == "furnace") return BenchScene{MakeFurnace(0.5f, 1.0f), {}};
  if (name_or_path == "city") {
    return BenchScene{MakeCity(small ? kSmallCityBlocks : kCityBlocks, kCitySeed), {}};
  }
  FP_ASSIGN_OR_RETURN(const AssetBundle asset, CollectAsset(name_or_path));
  FP_ASSIGN_OR_RETURN(ImportedScene imported, ImportScene(asset, ImportOptions()));
  EnsureCameraAndLight(imported, /*light_chosen=*/false);
  return BenchScene{std::move(imported.scene), std::move(imported.notes)};
}

}  // namespace farpoint
