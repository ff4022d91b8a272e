// The service's vocabulary as plain values: what client, coordinator and worker say to each other,
// whether over a wire (proto/convert.h) or within one process. No protobuf, no gRPC.
#pragma once

#include <array>
#include <chrono>
#include <compare>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "core/base/blob.h"
#include "core/base/hash.h"
#include "core/base/stats.h"
#include "core/base/status.h"
#include "core/image/tile_rect.h"
#include "core/math/vec.h"
#include "core/render/frame_renderer.h"
#include "core/render/settings.h"
#include "core/scene/asset.h"
#include "core/scene/importer.h"

namespace farpoint {

// Raised whenever an older peer would misunderstand a newer one. Each side says which versions it
// speaks, and they take the newest one of both. Checked at Submit and Register.
inline constexpr uint32_t kProtocolVersion = 3;
// 2 knows no owners, no health and no authentication, and says everything else in the same way.
inline constexpr uint32_t kOldestProtocolVersion = 2;
// Bulk data travel in pieces of this size; nobody sends or accepts larger ones.
inline constexpr size_t kChunkBytes = size_t{1} << 20;

// Identifiers that cannot be mixed up.
template <typename Tag>
struct Id {
  std::string value;
  auto operator<=>(const Id&) const = default;
  bool empty() const { return value.empty(); }
};
using JobId = Id<struct JobIdTag>;        // 8 hexadecimal digits, chosen by the coordinator
using WorkerId = Id<struct WorkerIdTag>;  // valid for one registration
using LeaseId = Id<struct LeaseIdTag>;

// --- The job ---------------------------------------------------------------------------------

struct LookAt {
  Vec3d eye, target;     // world, metres; different points
  Vec3d up{0, 1, 0};     // any length, not parallel to target - eye
  double yfov_deg = 45;  // of the whole frame's height, (0, 180)
};
struct CameraName {
  std::string name;
};
// monostate: the scene's first camera, or one made up if it has none.
using CameraChoice = std::variant<std::monostate, CameraName, LookAt>;

struct SunOverride {
  Vec3d to_sun;    // from the scene to the sun, any length but zero
  Rgb irradiance;  // on a facing surface, W/m²
};
// An environment map in place of the scene's sky and map; with SceneOverrides::sky both add up.
struct EnvironmentOverride {
  std::string uri;          // key in asset_files: a lat-long OpenEXR image
  Rgb scale{1, 1, 1};       // of its radiance, >= 0
  double rotation_deg = 0;  // of the map about `up`, counter-clockwise seen from above
  Vec3d up{0, 1, 0};        // world, any length: where the map's top row points
};
// The scene's materials of exactly this name.
struct MaterialOverride {
  std::string name;
  // [0, 1]; its texture is left out, unless the material is a mask, which needs the texture's alpha
  std::optional<Rgb> base_color;
  std::optional<Rgb> emission;  // radiance; its texture is left out
};
struct SceneOverrides {
  // One of them not empty: together in place of the scene's punctual lights.
  std::vector<SunOverride> suns;
  std::vector<PunctualLight> lights;
  std::optional<Rgb> sky;  // radiance, in place of the scene's sky
  std::optional<EnvironmentOverride> environment;
  std::optional<Rgb> albedo;  // of every material, [0, 1]; base-colour textures are left out
  std::vector<MaterialOverride> materials;  // in order, after `albedo`
};

// What a job may use at most. The coordinator has limits of its own; the smaller one wins.
struct JobLimits {
  uint64_t max_pixels = uint64_t{1} << 30;       // of the crop, of one frame
  uint64_t max_asset_bytes = uint64_t{1} << 36;  // all files together
  uint64_t max_triangles = 200'000'000;          // after instancing
  uint64_t max_surfels = uint64_t{1} << 31;
  uint64_t max_seconds = uint64_t{30} * 24 * 3600;  // from the start of rendering to the end
  bool operator==(const JobLimits&) const = default;
};
JobLimits Smaller(const JobLimits& a, const JobLimits& b);

struct JobSpec {
  std::string asset_root;                     // key of the main file in asset_files
  std::map<std::string, Digest> asset_files;  // by URI
  RenderSettings settings;
  FilmSpec film;  // width 0: not given yet (a job file may leave it to the command line)
  CameraChoice camera;
  SceneOverrides overrides;
  LightUnits light_units = LightUnits::kPhotometric;
  JobLimits limits;
  std::string title;     // at most 200 bytes
  int32_t priority = 0;  // higher goes first, -1000..1000

  // Empty: one still, at the scene's rest pose. Else the frames of an animation in the order
  // wanted, all different, at most kMaxFrames; frame f shows the scene at the time f / fps.
  std::vector<int32_t> frames;
  double fps = 24;           // (0, 1000]
  std::vector<JobId> after;  // jobs that must be done before this one starts; at most 64
  bool start_paused = false;

  // A still is one frame of number 0.
  uint32_t frame_count() const {
    return frames.empty() ? 1u : static_cast<uint32_t>(frames.size());
  }
  int32_t frame_number(uint32_t index) const { return frames.empty() ? 0 : frames[index]; }
  // Seconds; none for a still.
  std::optional<double> frame_time_s(uint32_t index) const {
    if (frames.empty()) return std::nullopt;
    return frames[index] / fps;
  }
};
inline constexpr int32_t kMinPriority = -1000, kMaxPriority = 1000;
inline constexpr size_t kMaxFrames = 100'000;
inline constexpr size_t kMaxAfter = 64;

// Everything that can be known without the scene: settings, film, camera, overrides, frames,
// limits, and that the asset names its root and its environment map among its files.
// kInvalidArgument names the field and what is allowed; kResourceExhausted the limit that the film
// exceeds.
absl::Status ValidateJob(const JobSpec& job);

// The camera that `choice` means in `scene`: kNotFound lists the scene's cameras if the name is
// not among them; kInvalidArgument if a LookAt has no direction.
absl::StatusOr<Camera> ResolveCamera(const CameraChoice& choice, const Scene& scene);

// Replaces what `overrides` names; files of the overrides are read from `asset`. kNotFound for a
// material that the scene does not have (the nearest names are given) or a file that is missing,
// kInvalidArgument for a map that cannot be read.
absl::Status ApplyOverrides(const SceneOverrides& overrides, const AssetBundle& asset,
                            Scene& scene);

// --- What is known about a job ---------------------------------------------------------------

enum class JobState : uint32_t {
  kQueued,     // waits for other jobs or for its first bake
  kBaking,     // its first frame is baked
  kRendering,  // from the first baked frame on
  kDone,
  kFailed,
  kCancelled,
  kPaused,  // not final, but no tile is leased and no bake started until it is resumed
};
std::string_view NameOf(JobState state);  // "queued", "baking", …
inline bool IsFinal(JobState s) {
  return s == JobState::kDone || s == JobState::kFailed || s == JobState::kCancelled;
}

// Tiles of all frames: index = frame index * tiles of a frame + tile within the frame.
// queued + leased + committed + failed = total, at any time. A tile whose frame is not baked yet is
// queued. In a cancelled job what is not committed is queued: nothing failed, and a requeue goes on
// there. In a failed job it is failed.
struct TileCounts {
  uint32_t queued = 0, leased = 0, committed = 0, failed = 0, total = 0;
  bool operator==(const TileCounts&) const = default;
};

struct FrameCounts {
  uint32_t total = 1, baked = 0, done = 0;  // done: all of its tiles are committed
  bool operator==(const FrameCounts&) const = default;
};

struct JobStatus {
  JobId id;
  std::string title;
  JobState state = JobState::kQueued;
  TileCounts tiles;
  uint64_t reissued = 0;         // leases lost, so that their tiles were queued again
  uint64_t refused_results = 0;  // stale or damaged
  std::optional<double> eta_s;
  absl::Status error;  // of a failed job; OK otherwise
  int32_t priority = 0;
  double progress = 0;  // [0, 1]; tiles in work count by their progress
  int64_t submitted_unix_ms = 0;
  FrameCounts frames;
  std::vector<JobId> after;
  std::string owner;  // who submitted it; empty: not known
  // Committed tiles of workers that were found to return wrong pixels after this job had ended.
  uint32_t suspect_tiles = 0;
};

struct WorkerStatus {
  WorkerId id;
  std::string name, version;
  uint32_t threads = 0;
  Digest fingerprint;
  uint32_t leases = 0;     // tiles that it works on
  uint64_t committed = 0;  // tiles
  uint64_t failures = 0;
  bool set_aside = false;
  double idle_s = 0;  // since it was last heard of
  bool gone = false;  // its connection broke or it is silent: it may come back, or be forgotten
};

struct TileCommitted {
  uint32_t tile = 0;
  Digest sha256;  // of its bytes
};
enum class LogLevel : uint32_t { kInfo, kWarning, kError };
std::string_view NameOf(LogLevel level);  // "info", "warning", "error"

// What happened to a job and is no news of its image: leases lost, results refused, failures of
// workers, pauses. At most kMaxLogLines of a job are kept; one more says that there were more.
struct LogLine {
  LogLevel level = LogLevel::kInfo;
  std::string text;
  std::optional<uint32_t> tile;
  uint32_t attempt = 0;  // of the tile; 0: none
  std::string worker;    // its name; may be empty
  bool operator==(const LogLine&) const = default;
};
inline constexpr uint32_t kMaxLogLines = 10'000;

// monostate: a passing report of progress.
using JobEventBody = std::variant<std::monostate, JobState, TileCommitted, std::string, LogLine>;
struct JobEvent {
  uint64_t sequence = 0;  // from 1, without gaps; 0 for a passing report, which is not kept
  JobEventBody body;      // the string is a note for the user
  JobStatus status;       // when it was sent
  int64_t unix_ms = 0;    // when it happened, by the coordinator's clock; 0: not known
};

// Why a job is in the state that it is in, for people: one line each.
struct Explanation {
  std::vector<std::string> lines;
};

// How a coordinator is: what `farpoint doctor` asks. Numbers are 0 where something is not known.
struct CoordinatorHealth {
  std::string version;
  uint32_t protocol_version = 0, oldest_protocol_version = 0;
  int64_t unix_ms = 0;  // by its clock
  bool draining = false;
  std::string caller_name, caller_role;  // how it knows the caller; empty without TLS
  std::string store_error;               // why its store cannot be written
  uint64_t store_free_bytes = 0, store_total_bytes = 0;
  uint64_t memory_available_bytes = 0, memory_total_bytes = 0;
  uint64_t open_files = 0, open_files_limit = 0;
  uint64_t connections = 0, max_connections = 0;
  uint64_t max_request_bytes = 0, max_blob_bytes = 0;
  JobLimits limits;
  uint64_t max_jobs = 0, max_bytes = 0;  // of the caller; 0: no limit
  uint64_t jobs = 0, bytes = 0;          // of the caller, now
  std::vector<WorkerStatus> workers;
  // A shared folder of blobs, and the name of a file that stands there now; empty: none.
  std::string blob_directory, blob_mark;
  int64_t certificate_not_after_s = 0;
};

struct SceneBlobs {
  Digest prepared_scene;
  Digest tree_topology;  // empty: the integrator needs none
  Digest tree_radiance;
  bool operator==(const SceneBlobs&) const = default;
};

struct TileInfo {
  PixelRect rect;
  Digest sha256;       // empty until it is committed
  uint32_t frame = 0;  // index into JobInfo::frames
};
// Row-major 4x4, row vectors (OpenEXR's convention): ndc = (x, y, z, 1) * world_to_ndc.
struct CameraMatrices {
  std::array<float, 16> world_to_camera{}, world_to_ndc{};
};
CameraMatrices MatricesOf(const Camera& camera, const FilmSpec& film);

struct FrameInfo {
  int32_t number = 0;
  bool baked = false;
  // All zero and empty before the frame is baked.
  CameraMatrices camera;
  SceneBlobs blobs;
};

// What a client must know to stitch and to write images.
struct JobInfo {
  JobStatus status;
  JobSpec spec;
  std::vector<TileInfo> tiles;    // in tile order; empty before the first frame is baked
  std::vector<FrameInfo> frames;  // in the order of the job; one of number 0 for a still
  Stats stats;                    // of the bakes in frame order and the committed tiles in theirs
  std::vector<std::string> notes;
  std::string version;  // of the coordinator
};

// The bytes of a committed tile: EncodeFilm of exactly its rectangle and the job's layers.
struct TileData {
  uint32_t tile = 0;
  Digest sha256;
  Blob bytes;
};

// --- Between coordinator and worker ----------------------------------------------------------

struct WorkerHello {
  std::string version;  // of farpoint
  Digest fingerprint;
  uint32_t threads = 1;
  std::string name;  // for people, at most 200 bytes
  // The name in the worker's certificate, which the coordinator read itself; never sent. Empty
  // without TLS.
  std::string certified_as;
};
struct WorkerWelcome {
  WorkerId id;
  std::chrono::milliseconds heartbeat{1000};  // how often to renew
  std::chrono::milliseconds max_wait{10000};  // of one Lease call
};

struct TileWork {
  LeaseId lease;
  uint32_t attempt = 0;  // of this tile, from 1
  JobId job;
  uint32_t tile = 0;
  PixelRect rect;
  uint32_t frame_index = 0;  // of the job: camera and blobs are equal for equal job and index
  FrameSpec frame;
  SceneBlobs blobs;
  std::chrono::milliseconds lease_time{0};  // lost if progress stops for so long
  // It failed before: one block after the other, each told of before it is begun.
  bool careful = false;
};

struct LeaseProgress {
  uint64_t counter = 0;    // grows while work is done
  float fraction = 0;      // [0, 1] of the tile, for people
  std::string at{};        // where the work is, for people; empty: not told
  bool rendering = false;  // blobs and scene are there
  // Processor time of the worker's whole process; 0: not known.
  std::chrono::milliseconds cpu{0};
  uint64_t pulse = 0;  // grows with small steps of the work (core/base/pulse.h); 0: not counted
};
inline constexpr size_t kMaxPlaceBytes = 200;  // of LeaseProgress::at
// Whether to go on after a heartbeat, and whether a result was taken.
struct RenewAnswer {
  bool drop = false;
  std::string reason;
};
struct ReturnAnswer {
  bool accepted = false;
  std::string reason;
  bool damaged = false;  // why not: the bytes are no good, not the lease; does not travel
};

struct TileResult {
  LeaseId lease;
  uint32_t attempt = 0;
  Digest sha256;  // of `bytes`
  Blob bytes;     // EncodeFilm
  Stats stats;
};

}  // namespace farpoint
