// Wire <-> plain values. Reading checks every field: a message from a peer is refused with
// kInvalidArgument naming the field, its value and what is allowed. Writing never fails. Pure
// functions, thread-safe.
#pragma once

#include <string>
#include <string_view>

#include "core/base/status.h"
#include "proto/farpoint.pb.h"
#include "proto/job.h"

namespace farpoint {

// --- The job file ----------------------------------------------------------------------------

// The JSON form of RenderJob; field names as in the .proto (snake_case) or in lowerCamelCase.
// `name` (the file's) is for messages. kInvalidArgument for anything that is not such a message:
// bad JSON by line and column, an unknown field by its path and the nearest known one, a wrong
// value by its path, the value and what is allowed.
absl::StatusOr<v1::RenderJob> RenderJobFromJson(std::string_view text, std::string_view name);
// Indented, snake_case.
std::string RenderJobToJson(const v1::RenderJob& job);

// Each field that is there is checked. What is absent gets its default; a film without a size and
// an asset without files are allowed here, since a job file may leave them to the command line:
// call ValidateJob (proto/job.h) once the job is complete.
absl::StatusOr<JobSpec> JobFromWire(const v1::RenderJob& wire);
v1::RenderJob ToWire(const JobSpec& job);

// --- Parts -----------------------------------------------------------------------------------

// `field` is the path for messages, e.g. "settings". ValidateSettings is called.
absl::StatusOr<RenderSettings> SettingsFromWire(const v1::RenderSettings& wire,
                                                std::string_view field);
v1::RenderSettings ToWire(const RenderSettings& settings);

// ValidateFilm is called.
absl::StatusOr<FilmSpec> FilmFromWire(const v1::Film& wire, std::string_view field);
v1::Film ToWire(const FilmSpec& film);

// All coordinates within [0, 65536], not empty.
absl::StatusOr<PixelRect> RectFromWire(const v1::Rect& wire, std::string_view field);
v1::Rect ToWire(const PixelRect& rect);

// Finite and orthonormal to 1e-6, field of view in (0, pi).
absl::StatusOr<Camera> CameraFromWire(const v1::Camera& wire, std::string_view field);
v1::Camera ToWire(const Camera& camera);

// 64 hexadecimal digits; an empty text is refused unless `allow_empty`.
absl::StatusOr<Digest> DigestFromWire(const std::string& hex, std::string_view field,
                                      bool allow_empty = false);
// Empty for the empty digest.
std::string ToWire(const Digest& digest);

// Known stages, finite and not negative seconds, at most 256 other entries of at most 64 bytes.
absl::StatusOr<Stats> StatsFromWire(const v1::Stats& wire);
v1::Stats ToWire(const Stats& stats);

absl::StatusOr<SceneBlobs> SceneBlobsFromWire(const v1::SceneBlobs& wire);
v1::SceneBlobs ToWire(const SceneBlobs& blobs);

// --- Messages --------------------------------------------------------------------------------

absl::StatusOr<JobStatus> JobStatusFromWire(const v1::JobStatus& wire);
v1::JobStatus ToWire(const JobStatus& status);

absl::StatusOr<WorkerStatus> WorkerStatusFromWire(const v1::WorkerStatus& wire);
v1::WorkerStatus ToWire(const WorkerStatus& status);

absl::StatusOr<JobEvent> JobEventFromWire(const v1::JobEvent& wire);
v1::JobEvent ToWire(const JobEvent& event);

absl::StatusOr<LogLine> LogLineFromWire(const v1::LogLine& wire);
v1::LogLine ToWire(const LogLine& line);

// At most 10,000 lines.
absl::StatusOr<Explanation> ExplanationFromWire(const v1::ExplainResponse& wire);
v1::ExplainResponse ToWire(const Explanation& explanation);

absl::StatusOr<JobInfo> JobInfoFromWire(const v1::FetchInfoResponse& wire);
v1::FetchInfoResponse ToWire(const JobInfo& info);

absl::StatusOr<WorkerHello> HelloFromWire(const v1::RegisterRequest& wire);
v1::RegisterRequest ToWire(const WorkerHello& hello);

absl::StatusOr<WorkerWelcome> WelcomeFromWire(const v1::RegisterResponse& wire);
v1::RegisterResponse ToWire(const WorkerWelcome& welcome);

absl::StatusOr<TileWork> TileWorkFromWire(const v1::TileWork& wire);
v1::TileWork ToWire(const TileWork& work);

// The bytes are not part of the header; `max_bytes` bounds its size_bytes.
struct ReturnHead {
  WorkerId worker;
  TileResult result;  // without bytes
  uint64_t size_bytes = 0;
};
absl::StatusOr<ReturnHead> ReturnHeadFromWire(const v1::ReturnHeader& wire, uint64_t max_bytes);
v1::ReturnHeader ToWire(const WorkerId& worker, const TileResult& result);

absl::StatusOr<CoordinatorHealth> HealthFromWire(const v1::DiagnoseResponse& wire);
v1::DiagnoseResponse ToWire(const CoordinatorHealth& health);

// The newest version that both sides speak: the peer those from `oldest` (0: `newest`) to `newest`,
// we those from kOldestProtocolVersion to kProtocolVersion. kFailedPrecondition, saying which side
// to update, if there is none. `peer` is "client" or "worker".
absl::StatusOr<uint32_t> AgreeOnProtocol(uint32_t oldest, uint32_t newest, std::string_view peer);

// kFailedPrecondition names a field of `message`, or of what it holds, that this version does not
// know: who leaves it out would do something else than was asked for. `where` is the message's
// path.
absl::Status CheckFieldsKnown(const google::protobuf::Message& message, std::string_view where);

}  // namespace farpoint
