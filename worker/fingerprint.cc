#include "worker/fingerprint.h"

#include <string_view>

#include "core/accel/accel_version.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"
#include "core/scene/procedural.h"

namespace farpoint {
namespace {

// Raised with every change of pixels that the small pictures below do not show: they have neither
// adaptive clusters nor gloss.
constexpr std::string_view kRevision = "revision 2";

}  // namespace

absl::StatusOr<Digest> ComputeFingerprint(Executor& executor) {
  const Scene scene = MakeCornellBox();
  Sha256 hash;
  hash.Update(FARPOINT_VERSION);
  hash.Update(kRevision);
  // A small picture does not show every rounding: builds for Debian 12 (g++ 12, Embree 3.13) and 13
  // (14, 4.3) agree on this one, and differ in pixels of a city.
  FP_ASSIGN_OR_RETURN(const std::string accel, AccelVersion());
  hash.Update(accel);
  hash.Update(__VERSION__);  // the compiler's
  for (const Integrator integrator : {Integrator::kFpbgi, Integrator::kPt}) {
    FrameSpec frame;
    frame.camera = scene.cameras.front();
    frame.film = {
        .width = kBlockSize, .height = kBlockSize, .crop = {0, 0, kBlockSize, kBlockSize}};
    frame.settings.integrator = integrator;
    frame.settings.points = 2000;
    frame.settings.light_samples = 1;
    frame.settings.paths = 4;
    frame.settings.clusters = 8;
    frame.settings.microbuffer = 8;
    Stats stats;
    FP_ASSIGN_OR_RETURN(const BakedScene baked, Bake(scene, frame.settings, executor, stats));
    FP_ASSIGN_OR_RETURN(auto loaded, LoadedScene::Load(baked, executor));
    FP_ASSIGN_OR_RETURN(const auto renderer, FrameRenderer::Create(std::move(loaded), frame));
    FP_ASSIGN_OR_RETURN(const TileOutput tile,
                        renderer->RenderTile(frame.film.crop, executor, {}, nullptr));
    const Digest image = ImageHash(tile.film);
    hash.Update(std::as_bytes(std::span(image.bytes)));
  }
  return hash.Finish();
}

}  // namespace farpoint
