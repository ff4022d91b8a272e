// Writes the frames of a job as they arrive: images, previews, and what --json reports of them. Not
// thread-safe.
#pragma once

#include <chrono>
#include <string>
#include <vector>

#include "client/console.h"
#include "client/frame_path.h"
#include "client/job_run.h"
#include "client/reports.h"
#include "core/base/status.h"
#include "core/image/exr_io.h"

namespace farpoint {

struct OutputOptions {
  std::string exr;   // with a place for the frame's number if there is more than one
  std::string png;   // empty: no preview; else as `exr`
  std::string json;  // file for the statistics; "-": stdout; empty: none
  float exposure_stops = 0;
  ExrCompression compression = ExrCompression::kZip;
};

// "-" is stdout, all else a file that is written beside its place and renamed.
absl::Status WriteText(const std::string& file, const std::string& text);

class ImageWriter {
 public:
  // `start` is when the command began. `console` must outlive this. kInvalidArgument names a file
  // name that has more than one place for the frame's number.
  static absl::StatusOr<ImageWriter> Create(OutputOptions options,
                                            std::chrono::steady_clock::time_point start,
                                            Console& console);

  // kInvalidArgument unless the names tell the images of `frames` frames apart. `sequence`: they
  // are numbered; a still's name is taken as it stands.
  absl::Status CheckNames(size_t frames, bool sequence) const;

  // One frame's files. Each is whole or absent.
  absl::Status Write(const JobInfo& info, const FetchedFrame& frame);

  // What a viewer shows a frame as: the name of its file, without folders. `frame` is an index.
  std::string NameOf(const JobInfo& info, uint32_t frame) const;

  // The --json file, of all frames that were written.
  absl::Status WriteStatistics() const;

  const std::vector<FrameReport>& written() const { return written_; }

 private:
  ImageWriter(OutputOptions options, FramePath exr, FramePath png,
              std::chrono::steady_clock::time_point start, Console& console);

  OutputOptions options_;
  FramePath exr_path_, png_path_;
  std::chrono::steady_clock::time_point start_;
  Console* console_;
  std::vector<FrameReport> written_;
  bool sequence_ = false;
  Stats stats_;  // of the last frame's job, the newest
};

}  // namespace farpoint
