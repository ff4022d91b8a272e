#include "client/job_request.h"

#include <algorithm>
#include <filesystem>
#include <utility>

#include "core/base/blob.h"
#include "core/scene/environment_image.h"
#include "core/scene/importer.h"
#include "proto/convert.h"

namespace farpoint {
namespace {

constexpr size_t kMaxJobFileBytes = size_t{16} << 20;
constexpr size_t kMaxEnvironmentBytes = size_t{2} << 30;

struct JobFile {
  std::string asset_path;
  JobSpec spec;
};

absl::StatusOr<JobFile> ReadJobFile(const std::string& path) {
  FP_ASSIGN_OR_RETURN(const Blob blob, ReadFile(path, kMaxJobFileBytes));
  const std::string_view text(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
  FP_ASSIGN_OR_RETURN(const v1::RenderJob wire, RenderJobFromJson(text, path));
  if (wire.asset().root().empty()) {
    return absl::InvalidArgumentError(path +
                                      ": asset.root: not given; name the scene's file, "
                                      "relative to the job file");
  }
  if (wire.asset().files_size() > 0) {
    return absl::InvalidArgumentError(path +
                                      ": asset.files: is found by farpoint itself; leave "
                                      "it out of the job file");
  }
  const std::filesystem::path root(wire.asset().root());
  JobFile file;
  file.asset_path = root.is_absolute()
                        ? root.string()
                        : (std::filesystem::path(path).parent_path() / root).string();
  if (IsJobFile(file.asset_path)) {
    return absl::InvalidArgumentError(path + ": asset.root: " + wire.asset().root() +
                                      " is a job file; name a .gltf, .glb, .obj or .ply");
  }
  FP_RETURN_IF_ERROR(Annotate(CheckScenePath(file.asset_path), path + ": asset.root"));
  auto spec = JobFromWire(wire);
  FP_RETURN_IF_ERROR(Annotate(spec.status(), path));
  file.spec = *std::move(spec);
  if (auto& environment = file.spec.overrides.environment) {
    environment->uri = (std::filesystem::path(path).parent_path() / environment->uri).string();
  }
  return file;
}

// Reads the file at the path that is the environment's uri until now, and gives it a name among the
// asset's files that says nothing of this machine's folders.
absl::Status AddEnvironment(EnvironmentOverride& environment, AssetBundle& asset) {
  const std::string context = "environment map " + environment.uri;
  auto file = ReadFile(environment.uri, kMaxEnvironmentBytes);
  FP_RETURN_IF_ERROR(Annotate(file.status(), context));
  // Hours may lie between this and the coordinator's reading.
  Environment decoded;
  FP_RETURN_IF_ERROR(LoadEnvironmentMap(*file, environment.uri, decoded));
  std::string uri = "env/" + std::filesystem::path(environment.uri).filename().string();
  const auto there = asset.files.find(uri);
  if (there != asset.files.end() && there->second.Hash() != file->Hash()) {
    uri = "env/" + file->Hash().Hex() + std::filesystem::path(environment.uri).extension().string();
  }
  asset.files[uri] = *std::move(file);
  environment.uri = uri;
  return absl::OkStatus();
}

v1::RenderJob ImageJob(JobSpec spec) {
  const RenderSettings defaults;
  spec.settings.tile_px = defaults.tile_px;
  // Only cuts change by it: nodes below the horizon are part of them.
  const bool cuts = spec.settings.point_based() && spec.settings.fill_in_force() == Fill::kCut;
  if (!cuts) spec.settings.no_skip = defaults.no_skip;
  spec.title.clear();
  spec.priority = 0;
  spec.after.clear();
  spec.start_paused = false;
  // Of no effect on a still.
  if (spec.frames.empty()) spec.fps = JobSpec().fps;
  v1::RenderJob wire = ToWire(spec);
  wire.clear_limits();
  wire.mutable_settings()->clear_tile_px();
  if (!cuts) wire.mutable_settings()->clear_no_skip();
  return wire;
}

std::vector<std::string> NotesOn(const PreparedRequest& request, std::span<const GivenFlag> flags) {
  if (request.spec.frames.empty()) {
    const bool fps = std::any_of(flags.begin(), flags.end(),
                                 [](const GivenFlag& flag) { return flag.first == "--fps"; });
    if (fps) return {"--fps says nothing of a still; --frames renders the animation"};
    return {};
  }
  // A scene that is wrong is refused later, with its place.
  const auto animation = FindAnimation(request.asset);
  if (!animation.ok() || animation->has_value()) return {};
  return {"the scene has no animation: all of its frames are alike"};
}

}  // namespace

absl::StatusOr<PreparedRequest> PrepareRequest(const std::string& scene,
                                               std::span<const GivenFlag> flags,
                                               bool& usage_error) {
  usage_error = true;
  FP_RETURN_IF_ERROR(CheckScenePath(scene));
  usage_error = false;
  JobFile file{.asset_path = scene};
  if (IsJobFile(scene)) {
    FP_ASSIGN_OR_RETURN(file, ReadJobFile(scene));
  }
  usage_error = true;
  FP_RETURN_IF_ERROR(ApplyRenderFlags(flags, file.spec));
  usage_error = false;

  PreparedRequest request{.spec = std::move(file.spec)};
  FP_ASSIGN_OR_RETURN(
      request.asset,
      CollectAsset(file.asset_path, request.spec.settings.materials == Materials::kGltf));
  if (request.spec.overrides.environment) {
    FP_RETURN_IF_ERROR(AddEnvironment(*request.spec.overrides.environment, request.asset));
  }
  request.spec.asset_root = request.asset.root;
  request.spec.asset_files.clear();
  for (const auto& [uri, blob] : request.asset.files) {
    request.spec.asset_files[uri] = blob.Hash();
  }
  FP_RETURN_IF_ERROR(Annotate(ValidateJob(request.spec), scene));
  request.notes = NotesOn(request, flags);
  request.warnings = IneffectiveFlags(flags, request.spec.settings);
  return request;
}

JobSpec SpecOfFrame(const JobSpec& spec, uint32_t frame) {
  JobSpec one = spec;
  if (!spec.frames.empty()) one.frames = {spec.frames[frame]};
  return one;
}

std::string ImageSettingsJson(const JobSpec& spec) { return RenderJobToJson(ImageJob(spec)); }

Digest JobHash(const JobSpec& spec) {
  // No map fields, so the encoding of equal messages is equal.
  const std::string bytes = ImageJob(spec).SerializeAsString();
  return Sha256().Update(bytes).Finish();
}

}  // namespace farpoint
