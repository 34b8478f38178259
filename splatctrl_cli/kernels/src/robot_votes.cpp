#include "robot_votes.h"

#include <algorithm>
#include <limits>

namespace splatctrl {
namespace {

struct Vote {
  std::int64_t cell[3];
  std::uint8_t* kind;  // of its pixel
};

std::vector<Vote> votes_of(const std::vector<VoteImage>& images, const VoteRule& rule) {
  std::vector<Vote> votes;
  for (const VoteImage& one : images) {
    const ChosenDepth& image = one.image;
    const std::size_t size = static_cast<std::size_t>(image.width) * image.height;
    for (std::size_t pixel = 0; pixel < size; ++pixel) {
      const std::uint8_t kind = one.kinds[pixel];
      if (!image.chosen[pixel] || (kind != rule.robot && kind != rule.object)) continue;
      double point[3];
      back_project_pixel(image, pixel, point);
      Vote vote{{}, one.kinds + pixel};
      for (int k = 0; k < 3; ++k) {
        vote.cell[k] = static_cast<std::int64_t>(std::floor((point[k] - rule.origin[k]) / rule.voxel + 0.5));
      }
      votes.push_back(vote);
    }
  }
  return votes;
}

}  // namespace

void outvote(const std::vector<VoteImage>& images, const VoteRule& rule) {
  const std::vector<Vote> votes = votes_of(images, rule);
  constexpr std::int64_t kFar = std::numeric_limits<std::int64_t>::max();
  std::int64_t low[3] = {kFar, kFar, kFar}, high[3] = {-kFar, -kFar, -kFar};  // of the robot's voxels
  for (const Vote& vote : votes) {
    for (int k = 0; k < 3 && *vote.kind == rule.robot; ++k) {
      low[k] = std::min(low[k], vote.cell[k]);
      high[k] = std::max(high[k], vote.cell[k]);
    }
  }
  if (low[0] > high[0]) return;
  struct Count {
    std::uint32_t robot = 0, object = 0;
  };
  std::vector<Count> counts((high[0] - low[0] + 1) * (high[1] - low[1] + 1) * (high[2] - low[2] + 1));
  const auto count_at = [&](const std::int64_t* cell) -> Count* {
    std::size_t index = 0;
    for (int k = 0; k < 3; ++k) {
      if (cell[k] < low[k] || cell[k] > high[k]) return nullptr;
      index = index * (high[k] - low[k] + 1) + (cell[k] - low[k]);
    }
    return &counts[index];
  };
  for (const Vote& vote : votes) {
    if (Count* count = count_at(vote.cell)) ++(*vote.kind == rule.robot ? count->robot : count->object);
  }
  for (const Vote& vote : votes) {
    const Count* count = *vote.kind == rule.object ? count_at(vote.cell) : nullptr;
    if (count && count->object < rule.share * count->robot) *vote.kind = rule.outvoted;
  }
}

}  // namespace splatctrl
