#include "server/frame_bakery.h"

#include <optional>
#include <utility>

namespace farpoint {

namespace {

absl::Status CheckLimit(const Stats& stats, const std::string& what, uint64_t limit) {
  const auto at = stats.counts.find(what);
  if (at == stats.counts.end() || at->second <= limit) return absl::OkStatus();
  return absl::ResourceExhaustedError("the scene has " + std::to_string(at->second) + " " + what +
                                      ", the limit is " + std::to_string(limit) +
                                      "; raise limits.max_" + what + " or take a smaller scene");
}

}  // namespace

absl::StatusOr<FrameBake> FrameBakery::Bake(const JobSpec& spec, uint32_t index,
                                            const std::atomic<bool>& stop) {
  const std::optional<double> time_s = spec.frame_time_s(index);
  // Whether the scene is animated is known once it was baked: a bake that holds at all times stands
  // under a key without time.
  const Digest always = BakeKey(spec), now = BakeKeyAt(spec, time_s);
  StoredBake bake;
  FrameBake result;
  FP_ASSIGN_OR_RETURN(std::optional<StoredBake> known, Find(always));
  if (!known) {
    FP_ASSIGN_OR_RETURN(known, Find(now));
  }
  if (known) {
    bake = *std::move(known);
    result.reused = true;
    // The time was spent by the job that baked, and what it skipped is its affair.
    bake.stats.seconds = {};
    bake.stats.wall_seconds = {};
    bake.stats.skipped = {{"bake", 1}};
  } else {
    FP_ASSIGN_OR_RETURN(bake, Make(spec, time_s, stop));
    FP_RETURN_IF_ERROR(store_.PutBake(bake.animated ? now : always, bake));
  }
  FP_RETURN_IF_ERROR(CheckLimit(bake.stats, "triangles", spec.limits.max_triangles));
  FP_RETURN_IF_ERROR(CheckLimit(bake.stats, "surfels", spec.limits.max_surfels));
  Scene cameras;
  cameras.cameras = std::move(bake.cameras);
  FP_ASSIGN_OR_RETURN(result.frame.camera, ResolveCamera(spec.camera, cameras));
  if (bake.made_up_camera && std::holds_alternative<LookAt>(spec.camera)) {
    std::erase_if(bake.notes,
                  [](const std::string& note) { return note.starts_with("no camera"); });
  }
  result.frame.blobs = bake.blobs;
  result.animated = bake.animated;
  result.notes = std::move(bake.notes);
  result.stats = std::move(bake.stats);
  return result;
}

// Nothing also if its record or a blob of it is damaged: then it is made again.
absl::StatusOr<std::optional<StoredBake>> FrameBakery::Find(const Digest& key) {
  absl::StatusOr<std::optional<StoredBake>> known = store_.FindBake(key);
  if (absl::IsDataLoss(known.status()) || absl::IsInvalidArgument(known.status())) {
    return std::nullopt;
  }
  if (!known.ok() || !known->has_value()) return known;
  const SceneBlobs& blobs = (*known)->blobs;
  for (const Digest& d : {blobs.prepared_scene, blobs.tree_topology, blobs.tree_radiance}) {
    if (!d.empty() && !blobs_.Get(d).ok()) return std::nullopt;
  }
  return known;
}

absl::StatusOr<StoredBake> FrameBakery::Make(const JobSpec& spec, std::optional<double> time_s,
                                             const std::atomic<bool>& stop) {
  AssetBundle asset;
  asset.root = spec.asset_root;
  uint64_t total = 0;
  for (const auto& [uri, digest] : spec.asset_files) {
    absl::StatusOr<Blob> blob = blobs_.Get(digest);
    if (!blob.ok()) return Annotate(blob.status(), "asset file '" + uri + "'");
    total += blob->size();
    asset.files.emplace(uri, *std::move(blob));
  }
  if (total > spec.limits.max_asset_bytes) {
    return absl::ResourceExhaustedError(
        "the asset has " + std::to_string(total) + " bytes, the limit is " +
        std::to_string(spec.limits.max_asset_bytes) + "; raise limits.max_asset_bytes");
  }
  FP_ASSIGN_OR_RETURN(BakeResult result, baker_->Bake(asset, spec, time_s, stop));
  StoredBake bake;
  FP_ASSIGN_OR_RETURN(bake.blobs.prepared_scene, Keep(result.blobs.prepared_scene));
  FP_ASSIGN_OR_RETURN(bake.blobs.tree_topology, Keep(result.blobs.tree_topology));
  FP_ASSIGN_OR_RETURN(bake.blobs.tree_radiance, Keep(result.blobs.tree_radiance));
  bake.cameras = std::move(result.cameras);
  bake.made_up_camera = result.made_up_camera;
  bake.notes = std::move(result.notes);
  bake.animated = result.animated;
  bake.stats = std::move(result.stats);
  return bake;
}

absl::StatusOr<Digest> FrameBakery::Keep(const Blob& blob) {
  if (blob.size() == 0) return Digest{};
  const Digest digest = blob.Hash();
  FP_RETURN_IF_ERROR(blobs_.Put(digest, blob));
  return digest;
}

}  // namespace farpoint
