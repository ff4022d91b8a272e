// Pixels of a rectangle: some layers, each with its channels, in float. What a tile is rendered
// into and what the client stitches.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include "core/base/hash.h"
#include "core/base/status.h"
#include "core/image/layers.h"
#include "core/image/tile_rect.h"

namespace farpoint {

// Not thread-safe for writes to the same pixel.
class Film {
 public:
  Film() = default;
  // All zeros. `layers` is sorted into the fixed order and made unique.
  Film(const PixelRect& rect, std::vector<Layer> layers);

  const PixelRect& rect() const { return rect_; }
  std::span<const Layer> layers() const { return layers_; }
  bool Has(Layer layer) const;
  // channels x height x width, channel-major: plane c starts at c * area. Empty if absent.
  std::span<float> Plane(Layer layer, int channel);
  std::span<const float> Plane(Layer layer, int channel) const;

  void Set(Layer layer, int x, int y, std::span<const float> channels);  // frame coordinates
  float Get(Layer layer, int channel, int x, int y) const;

  // Copies the pixels of `other` that lie inside this film; the layers must be the same.
  void Paste(const Film& other);

  // Rounds every value to what its layer stores (half layers to binary16, -0 to +0), so that hashes
  // and files agree. Idempotent. NaN and infinities stay what they are: DecodeFilm refuses them.
  void RoundToStorage();

 private:
  PixelRect rect_;
  std::vector<Layer> layers_;
  std::vector<size_t> first_;  // per layer, into values_
  std::vector<float> values_;
};

// The bytes of a tile as they travel and are kept: a header (rect, layers) and the stored values,
// per layer, per block in raster order, channels in order, rows top down; halves where the layer
// stores halves. Lossless for a film that was rounded to storage. Format: docs/protocol.md.
std::vector<std::byte> EncodeFilm(const Film& film);
// kDataLoss for anything that is not exactly such a record (encoding the result gives the same
// bytes), and for values that no kernel may produce: NaN, -0, infinities except +inf in kDepth.
// Sizes are checked before allocation.
absl::StatusOr<Film> DecodeFilm(std::span<const std::byte> bytes);

// The hash of a block of a layer is SHA-256 over its stored values; a film's layer hash
// combines its blocks' hashes in raster order; its image hash combines all layers'. Blocks are
// those of the frame's grid clipped to `film.rect()`, so neither tile size nor order enters.
// The film must have been rounded to storage.
Digest LayerHash(const Film& film, Layer layer);
Digest ImageHash(const Film& film);

}  // namespace farpoint
