// What the stability benchmark does to scenes, and the scenes that it makes up.
#pragma once

#include <cstdint>
#include <string_view>
#include <vector>

#include "core/math/affine.h"
#include "core/scene/scene.h"

namespace farpoint {

// A scene and who looks at it.
struct StabilityScene {
  Scene scene;
  Camera camera;
};

// --- The same scene in another shape: every pixel must stay what it is ---

// `world` is a rotation, a mirroring or a translation times `scale` > 0: it is put in front of the
// transforms of all instances, lights and the camera, and powers of punctual lights grow by scale².
// A mirrored camera is left-handed, so that each pixel sees what it saw. A scene with an
// environment map may only be moved and scaled.
StabilityScene Transformed(const StabilityScene& source, const Affine& world, double scale);

Affine ScalingBy(double scale);
Affine TranslationBy(const Vec3d& offset);
// About an axis of any length > 0.
Affine RotationAbout(const Vec3d& axis, double angle_rad);
Affine MirroringX();

// Instances, meshes and triangles in another order, and the triangles' first corners turned.
Scene Permuted(const Scene& source, uint64_t seed);
// Every triangle cut into four, and every mesh into two by turns of its triangles.
Scene Split(const Scene& source);

// --- Degenerate geometry in a scene ---

// Triangles without area within each mesh: a corner twice, three corners in a line.
Scene WithFlatTriangles(const Scene& source);
// The same triangles, but in meshes of their own.
Scene WithFlatMeshes(const Scene& source);
// With a white triangle of half a square metre at `at`.
Scene WithStray(const Scene& source, const Vec3d& at);
// With a black square of 2 `half_m` in the plane y = `y`, about the axis: nothing in a frame knows
// of it but what sees it.
Scene WithBlackGround(const Scene& source, double half_m, double y);
// Each triangle loses a needle, 10^6 times as long as it is wide, along its side opposite to the
// first corner; the needle is a triangle of its own.
Scene WithNeedles(const Scene& source);
// All triangles twice, in the same place.
Scene WithDuplicates(const Scene& source);

enum class BadNormals { kLong, kTiny, kZero, kNan, kInfinite, kOpposed };
// Vertex normals for meshes of flat polygons with vertices of their own: what is left of them must
// be the polygons' normals. `kind` says what is wrong with them.
Scene WithNormals(const Scene& source, BadNormals kind);
// The same with correct unit normals.
Scene WithFlatNormals(const Scene& source);

// --- Scenes ---

// The Cornell box with three sheets on its floor that share one upright edge, vertices included:
// open and non-manifold.
StabilityScene SheetsInTheBox();
// A floor of 2 km, two triangles, with a bowl of `n` x `n` x 2 triangles of a millimetre on it.
StabilityScene TinyBesideHuge(unsigned n);
// A sun over one plane without end in sight: nothing lights the plane but the sun.
StabilityScene OnePlane();
// Two closed rooms that touch nowhere, walls of reflectance 0.5 that radiate `bright` and `dim`;
// the camera is in the second. E of one bounce is pi 0.5 dim.
StabilityScene BrightBesideDim(float bright, float dim);
// Many leaves, each a sheet on its own, and spheres of 20 triangles, far from the camera: normals
// within a node of the point tree cancel.
StabilityScene Leaves(unsigned count, uint64_t seed);
// The Cornell box, seen where the short box stands on the floor.
StabilityScene Contact();

Camera CameraAt(const Vec3d& eye, const Vec3d& target, double yfov_deg);

}  // namespace farpoint
