// A job with made-up pixels, for tests of what happens around them.
#pragma once

#include <utility>
#include <vector>

#include "core/image/film.h"
#include "proto/job.h"

namespace farpoint {

// Deterministic values that differ from pixel to pixel and frame to frame, rounded to storage.
inline Film SampleFilm(const PixelRect& rect, const std::vector<Layer>& layers,
                       uint32_t frame = 0) {
  Film film(rect, layers);
  for (const Layer layer : film.layers()) {
    const size_t channels = InfoOf(layer).channels.size();
    for (size_t c = 0; c < channels; ++c) {
      std::span<float> plane = film.Plane(layer, static_cast<int>(c));
      for (int y = rect.y0; y < rect.y1; ++y) {
        for (int x = rect.x0; x < rect.x1; ++x) {
          plane[static_cast<size_t>(y - rect.y0) * rect.width() + (x - rect.x0)] =
              0.01f * static_cast<float>(x) + 0.5f * static_cast<float>(y) + static_cast<float>(c) +
              static_cast<float>(layer) + 100.0f * static_cast<float>(frame);
        }
      }
    }
  }
  film.RoundToStorage();
  return film;
}

struct SampleJob {
  JobInfo info;
  std::vector<TileData> tiles;
};

// A job that is done, of 32-pixel tiles. `frames`: none for a still. The tiles of a frame differ
// from those of another one in every beauty value.
inline SampleJob MakeSampleJob(const FilmSpec& film, std::vector<int32_t> frames = {}) {
  SampleJob job;
  job.info.status.id = JobId{"0badcafe"};
  job.info.status.state = JobState::kDone;
  job.info.spec.film = film;
  job.info.spec.settings.layers = {Layer::kBeauty, Layer::kDepth};
  job.info.spec.settings.tile_px = 32;
  job.info.spec.frames = std::move(frames);
  job.info.version = FARPOINT_VERSION;
  const uint32_t frame_count = job.info.spec.frame_count();
  for (uint32_t frame = 0; frame < frame_count; ++frame) {
    FrameInfo& info = job.info.frames.emplace_back();
    info.number = job.info.spec.frame_number(frame);
    info.baked = true;
    info.blobs.prepared_scene = Sha256().Update(std::to_string(info.number)).Finish();
    info.camera.world_to_camera[0] = static_cast<float>(frame + 1);
    for (const PixelRect& rect : TilesOf(film, 32)) {
      TileData tile;
      tile.tile = static_cast<uint32_t>(job.tiles.size());
      tile.bytes =
          Blob::FromVector(EncodeFilm(SampleFilm(rect, job.info.spec.settings.layers, frame)));
      tile.sha256 = tile.bytes.Hash();
      job.info.tiles.push_back({rect, tile.sha256, frame});
      job.tiles.push_back(std::move(tile));
    }
  }
  const auto count = static_cast<uint32_t>(job.tiles.size());
  job.info.status.tiles = {.committed = count, .total = count};
  job.info.status.frames = {.total = frame_count, .baked = frame_count, .done = frame_count};
  job.info.status.progress = 1;
  return job;
}

}  // namespace farpoint
