// The robot's and other objects' pixels in one voxel.
#pragma once

#include <cstdint>
#include <vector>

#include "points.h"

namespace splatctrl {

// Pixels that vote are `image.chosen`; kinds (H, W): what each pixel shows.
struct VoteImage {
  ChosenDepth image;
  std::uint8_t* kinds;
};

// Voxels of a grid with first centre `origin` [m]; share: of the robot's pixels, fewer object pixels are none.
struct VoteRule {
  double origin[3], voxel, share;
  std::uint8_t robot, object, outvoted;
};

// Makes object pixels `outvoted` in each voxel where images count fewer of them than `share` times the robot's.
void outvote(const std::vector<VoteImage>& images, const VoteRule& rule);

}  // namespace splatctrl
