// The scenes of the skip benchmark: each has much, or nothing, of what one item leaves out.
#pragma once

#include <cstdint>

#include "core/scene/scene.h"

namespace farpoint {

// `n` by `n` closed rooms of 4 x 3 x 4 m in a row and file, each with a lamp and some furniture;
// the camera stands in the middle one and sees nothing of the others.
Scene MakeRooms(unsigned n);
// A floor with `n` by `n` closed boxes on it under a sun and nothing else; n >= 1.
Scene MakeBoxes(unsigned n);
// The Cornell box with walls, floor and boxes of which all but the floor are black.
Scene MakeBlackBox();
// The Cornell box, and before its lower three quarters a black lamp.
Scene MakeLampBeforeBox();
// The Cornell box without its light.
Scene MakeDarkBox();
// The Cornell box with eight spot lights outside that point away from it.
Scene MakeSpotsAside();
// A floor under one light that reaches all of it.
Scene MakeLitFloor();
// The same under a constant sky.
Scene MakeOpenFloor();
// The Cornell box with `count` textures of `side` x `side` pixels that no surface shows.
Scene MakeUnusedTextures(unsigned count, unsigned side);

}  // namespace farpoint
