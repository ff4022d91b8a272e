#include "client/image_writer.h"

#include <algorithm>
#include <cerrno>
#include <cstdio>
#include <span>
#include <utility>

#include "core/base/blob.h"

namespace farpoint {
namespace {

double SecondsSince(std::chrono::steady_clock::time_point start) {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

absl::Status CheckName(const FramePath& path, const std::string& flag, const std::string& name,
                       size_t frames) {
  if (name.empty() || path.has_place() || frames <= 1) return absl::OkStatus();
  const size_t dot = name.rfind('.');
  return absl::InvalidArgumentError(flag + " " + name + ": the job has " + std::to_string(frames) +
                                    " frames; leave a place for their number, e.g. " +
                                    name.substr(0, dot) + ".####" + name.substr(dot));
}

}  // namespace

absl::Status WriteText(const std::string& file, const std::string& text) {
  if (file != "-") return WriteFileAtomically(file, std::as_bytes(std::span(text)));
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() || std::fflush(stdout) != 0) {
    if (errno == EPIPE) return absl::OkStatus();  // the reader has seen enough, as head does
    return absl::UnavailableError("stdout cannot be written");
  }
  return absl::OkStatus();
}

ImageWriter::ImageWriter(OutputOptions options, FramePath exr, FramePath png,
                         std::chrono::steady_clock::time_point start, Console& console)
    : options_(std::move(options)),
      exr_path_(std::move(exr)),
      png_path_(std::move(png)),
      start_(start),
      console_(&console) {}

absl::StatusOr<ImageWriter> ImageWriter::Create(OutputOptions options,
                                                std::chrono::steady_clock::time_point start,
                                                Console& console) {
  auto exr = FramePath::Parse(options.exr);
  FP_RETURN_IF_ERROR(Annotate(exr.status(), "-o " + options.exr));
  auto png = FramePath::Parse(options.png);
  FP_RETURN_IF_ERROR(Annotate(png.status(), "--png " + options.png));
  return ImageWriter(std::move(options), *std::move(exr), *std::move(png), start, console);
}

absl::Status ImageWriter::CheckNames(size_t frames, bool sequence) const {
  if (!sequence) {
    if (exr_path_.has_place()) {
      console_->Warn("-o " + options_.exr +
                     ": the job is a still, so the name is taken as it stands; --frames renders an "
                     "animation");
    }
    return absl::OkStatus();
  }
  FP_RETURN_IF_ERROR(CheckName(exr_path_, "-o", options_.exr, frames));
  return CheckName(png_path_, "--png", options_.png, frames);
}

absl::Status ImageWriter::Write(const JobInfo& info, const FetchedFrame& frame) {
  sequence_ = !info.spec.frames.empty();
  stats_ = info.stats;
  const FrameInfo& of_frame = info.frames[frame.frame];
  const FilmSpec& film = info.spec.film;
  FrameReport report;
  report.number = of_frame.number;
  report.file = sequence_ ? exr_path_.For(of_frame.number) : options_.exr;
  report.blobs = of_frame.blobs;
  report.image_hash = ImageHash(frame.film);
  report.missing_tiles = frame.missing_tiles;
  FP_RETURN_IF_ERROR(WriteExr(report.file, frame.film, film.width, film.height,
                              ImageMetadata(info, frame.frame, report.image_hash,
                                            options_.compression, frame.missing_tiles),
                              options_.compression));
  if (!options_.png.empty()) {
    FP_RETURN_IF_ERROR(WritePngPreview(sequence_ ? png_path_.For(of_frame.number) : options_.png,
                                       frame.film, options_.exposure_stops));
  }
  report.written_s = SecondsSince(start_);
  std::string text = "wrote " + report.file + ", " + std::to_string(film.crop.width()) + "x" +
                     std::to_string(film.crop.height());
  if (frame.missing_tiles > 0) {
    text += ", without " + std::to_string(frame.missing_tiles) + " tiles that are not rendered yet";
  }
  console_->Info(text + ", in " + DurationText(report.written_s) + ", image hash " +
                 report.image_hash.Hex() +
                 (IsLossless(options_.compression) ? "" : " before the lossy compression"));
  written_.push_back(std::move(report));
  return absl::OkStatus();
}

std::string ImageWriter::NameOf(const JobInfo& info, uint32_t frame) const {
  const std::string file =
      info.spec.frames.empty() ? options_.exr : exr_path_.For(info.frames[frame].number);
  return file.substr(file.rfind('/') + 1);
}

absl::Status ImageWriter::WriteStatistics() const {
  if (options_.json.empty()) return absl::OkStatus();
  Stats stats = stats_;
  uint64_t& peak_rss = stats.bytes["peak_rss"];
  peak_rss = std::max(peak_rss, PeakResidentBytes());
  return WriteText(options_.json, StatisticsJson(stats, written_, sequence_, SecondsSince(start_)));
}

}  // namespace farpoint
