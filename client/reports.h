// What other programs read: the JSON of --json, and the metadata of images. Pure functions.
#pragma once

#include <cstdint>
#include <string>

#include "client/farm_link.h"
#include "core/base/hash.h"
#include "core/base/status.h"
#include "core/image/compare.h"
#include "core/image/exr_io.h"
#include "proto/job.h"

namespace farpoint {

// The statistics file, exactly its keys (docs/commands.md): seconds.{stages, total, wall},
// wall_seconds.{stages}, counts.*, skipped.*, bytes.*, hash.{scene, tree, image}. A stage that did
// not run and a thing that was not counted are 0.
std::string StatisticsJson(const Stats& stats, const SceneBlobs& blobs, const Digest& image_hash,
                           double run_seconds);

// One digest for surfels, topology and radiance: SHA-256 over both digests' bytes; empty if there
// is no tree.
Digest TreeHash(const SceneBlobs& blobs);

// {id, state, tiles: {queued, leased, committed, failed, total}, reissued, refused_results, eta_s}
// and title, priority, progress, error; eta_s and error are null where there is none.
std::string JobStatusJson(const JobStatus& status);
// {jobs: […], workers: […]}
std::string FarmStatusJson(const FarmStatus& status);
// A table for people.
std::string FarmStatusText(const FarmStatus& status);

// mse, rel_rmse, rr, bias, max_abs, pdp, flip, hash_equal and what they were taken over. null where
// a measure does not exist.
std::string ComparisonJson(const CompareResult& result);
std::string ComparisonText(const CompareResult& result);

// farpoint:version, :jobHash, :imageHash, :settings, and the camera's matrices.
ExrMetadata ImageMetadata(const JobInfo& info, const Digest& image_hash);

// Peak resident memory of this process.
uint64_t PeakResidentBytes();

}  // namespace farpoint
