// The project's own scenes, made by code, and the writer that turns a Scene into glTF.
#pragma once

#include <string>

#include "core/base/status.h"
#include "core/scene/scene.h"

namespace farpoint {

// The Cornell box from the measured geometry published by Cornell University's Program of Computer
// Graphics; 1 unit = 100 mm, y up, the camera looks along +z. The ceiling is cut round the light.
// Albedos: the linear Rec. 709 values commonly derived from the measured spectra.
Scene MakeCornellBox();

// A closed box of edge 2 m about the origin whose inside is Lambert of reflectance `rho` and emits
// `radiance`; the camera is at its centre. One bounce gives E = pi * rho * radiance everywhere.
Scene MakeFurnace(float rho, float radiance);

// A city of blocks x blocks: streets, kerbs, buildings with windows, arcades and roofs, trees,
// deterministic from `seed`. Sun and sky; the camera stands at street level.
Scene MakeCity(unsigned blocks, uint64_t seed);

// Writes `path` (.gltf with its .bin beside it, or .glb), readable by any glTF 2.0 importer.
absl::Status WriteGltf(const Scene& scene, const std::string& path);

}  // namespace farpoint
