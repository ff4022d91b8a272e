// The project's own scenes, made by code, and the writer that turns a Scene into glTF.
#pragma once

#include <cstdint>
#include <string>

#include "core/base/status.h"
#include "core/scene/scene.h"

namespace farpoint {

// The Cornell box from the measured geometry published by Cornell University's Program of Computer
// Graphics; 1 unit = 100 mm, y up, the camera looks along +z. The ceiling is cut round the light.
// Albedos: the linear Rec. 709 values commonly derived from the measured spectra.
Scene MakeCornellBox();

// The Cornell box with gloss: the tall block is of copper, in place of the short one stands a
// sphere of blue plastic, both of this roughness in [0, 1].
Scene MakeGlossyCornellBox(float roughness);

// A closed box of edge 2 m about the origin whose inside is Lambert of reflectance `rho` and emits
// `radiance`; the camera is at its centre. One bounce gives E = pi * rho * radiance everywhere.
Scene MakeFurnace(float rho, float radiance);

// A city of blocks x blocks: streets, kerbs, buildings with windows, arcades and roofs, trees,
// deterministic from `seed`: the same bits on every machine. `blocks` in [1, 64] is clamped; each
// adds about 5,500 triangles and 17,000 m² of surface. Parts are instanced, some of them mirrored.
// Sun and sky; the first camera, "street", stands at eye level, the second is "aerial".
Scene MakeCity(unsigned blocks, uint64_t seed);

// Writes `path` (.gltf with its .bin beside it, or .glb), readable by any glTF 2.0 importer: one
// node for each instance, camera and light, KHR_lights_punctual in photometric units (683 lm/W),
// KHR_materials_emissive_strength, KHR_texture_transform, images inside the buffer, and a constant
// sky as {"farpoint_sky": [r, g, b]} in the extras of the scene. Equal content is written once.
// ImportScene gives the scene back; the order of instances stays. kInvalidArgument for an unknown
// extension or a mesh without triangles, kResourceExhausted for a .glb beyond 4 GiB, else what
// WriteFileAtomically says.
absl::Status WriteGltf(const Scene& scene, const std::string& path);

}  // namespace farpoint
