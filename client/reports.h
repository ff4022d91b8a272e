// What other programs read: the JSON of --json, and the metadata of images. Pure functions.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "client/farm_link.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"
#include "proto/job.h"

namespace farpoint {

// A frame whose image was written.
struct FrameReport {
  int32_t number = 0;
  std::string file;
  SceneBlobs blobs;
  Digest image_hash;
  uint32_t missing_tiles = 0;
  double written_s = 0;  // since the command started
};

// The statistics file, exactly its keys (docs/commands.md): seconds.{stages, total, wall},
// wall_seconds.{stages}, counts.*, skipped.*, bytes.*, hash.{scene, tree, image}. A stage that did
// not run and a thing that was not counted are 0. A sequence has frames[] too, in the order in
// which they were written; each of its hashes is SHA-256 over those of its frames, by number.
std::string StatisticsJson(const Stats& stats, std::span<const FrameReport> frames, bool sequence,
                           double run_seconds);

// One digest for surfels, topology and radiance: SHA-256 over both digests' bytes; empty if there
// is no tree.
Digest TreeHash(const SceneBlobs& blobs);

// {id, state, tiles: {queued, leased, committed, failed, total}, reissued, refused_results, eta_s}
// and frames: {total, baked, done}, after, title, priority, progress, error; eta_s and error are
// null where there is none.
std::string JobStatusJson(const JobStatus& status);
// An array of them.
std::string JobsJson(std::span<const JobStatus> jobs);
// {jobs: […], workers: […]}
std::string FarmStatusJson(const FarmStatus& status);
// {workers: […]}
std::string WorkersJson(std::span<const WorkerStatus> workers);
// {id, lines: […]}
std::string ExplanationJson(const JobId& job, const Explanation& explanation);
// Tables for people.
std::string FarmStatusText(const FarmStatus& status);
std::string WorkersText(std::span<const WorkerStatus> workers);

// An event of a job's history for people, in one line: time (UTC), level, what happened. Empty for
// a passing report.
std::string LogText(const JobEvent& event);
// The same as an object on one line: {time, sequence, level, text} and, where known, tile, attempt,
// worker, state. Empty for a passing report.
std::string LogJson(const JobEvent& event);

// mse, rel_rmse, rr, noise, noise_above_error, bias, max_abs, pdp, flip, hash_equal and what they
// were taken over. null where a measure does not exist.
std::string ComparisonJson(const CompareResult& result);
// What a person should know of the result, if anything: that the noise is above the error.
std::optional<std::string> ComparisonWarning(const CompareResult& result);
std::string ComparisonText(const CompareResult& result);

// What the header of a frame's image says: farpoint:version, :jobHash, :settings, the hash of the
// pixels, the camera's matrices, software, the title as comments; of a frame of a sequence its
// number and the frames per second. `frame` is an index into info.frames. farpoint:imageHash stands
// there only if the file's pixels are the rendered ones: under a lossy compression it is
// farpoint:renderedHash, of the pixels before it, and farpoint:lossy names the compression. An
// image with missing tiles says so in farpoint:missingTiles.
ExrMetadata ImageMetadata(const JobInfo& info, uint32_t frame, const Digest& image_hash,
                          ExrCompression compression, uint32_t missing_tiles);

// Peak resident memory of this process.
uint64_t PeakResidentBytes();

}  // namespace farpoint
