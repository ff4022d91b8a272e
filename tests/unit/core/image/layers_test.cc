#include "core/image/layers.h"

#include <gtest/gtest.h>

#include <set>
#include <string>

namespace farpoint {
namespace {

TEST(Layers, AreListedInTheOrderOfTheirNumbers) {
  ASSERT_EQ(AllLayers().size(), static_cast<size_t>(kLayerCount));
  for (size_t i = 0; i < AllLayers().size(); ++i) {
    EXPECT_EQ(static_cast<size_t>(AllLayers()[i].layer), i);
    EXPECT_EQ(&InfoOf(AllLayers()[i].layer), &AllLayers()[i]);
  }
}

TEST(Layers, NamesAndChannelsAreUniqueAndNamesAreFound) {
  std::set<std::string_view> names, channels;
  size_t channel_count = 0;
  for (const LayerInfo& info : AllLayers()) {
    names.insert(info.name);
    const absl::StatusOr<Layer> found = LayerFromName(info.name);
    ASSERT_TRUE(found.ok());
    EXPECT_EQ(*found, info.layer);
    for (const std::string_view channel : info.channels) {
      channels.insert(channel);
      ++channel_count;
      if (info.layer != Layer::kBeauty && info.layer != Layer::kDepth) {
        EXPECT_TRUE(channel.starts_with(std::string(info.name) + ".")) << channel;
      }
    }
  }
  EXPECT_EQ(names.size(), AllLayers().size());
  EXPECT_EQ(channels.size(), channel_count);
}

TEST(Layers, AnUnknownNameGetsTheNearestAndTheList) {
  const absl::Status status = LayerFromName("iradiance").status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_NE(status.message().find("did you mean 'irradiance'"), absl::string_view::npos) << status;
  EXPECT_NE(status.message().find("cutsize"), absl::string_view::npos);
  EXPECT_FALSE(LayerFromName("").ok());
  EXPECT_FALSE(LayerFromName(std::string(1 << 20, 'x')).ok());
}

TEST(Layers, TheDefaultsAreThoseOfTheManual) {
  const std::vector<Layer> expected = {Layer::kBeauty,   Layer::kDirect, Layer::kIndirect,
                                       Layer::kEmission, Layer::kAlbedo, Layer::kNormal,
                                       Layer::kPosition, Layer::kDepth};
  EXPECT_EQ(DefaultLayers(), expected);
}

}  // namespace
}  // namespace farpoint
