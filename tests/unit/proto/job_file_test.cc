#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "proto/convert.h"

namespace farpoint {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;
using ::testing::StartsWith;

std::string Refusal(const std::string& text) {
  const absl::StatusOr<v1::RenderJob> job = RenderJobFromJson(text, "my.json");
  EXPECT_TRUE(absl::IsInvalidArgument(job.status())) << text << ": " << job.status();
  return std::string(job.status().message());
}

TEST(JobFile, TakesBothNamingsAndNumbersInQuotes) {
  const absl::StatusOr<v1::RenderJob> job = RenderJobFromJson(
      R"({"asset": {"root": "a.glb"},
          "settings": {"light_samples": 3, "tilePx": 32, "epsilon": 1e-1, "spp": 4.0,
                       "integrator": "INTEGRATOR_PT", "seed": "18446744073709551615",
                       "layers": ["beauty"], "filter": 3, "noSkip": true},
          "film": {"width_px": 8, "heightPx": 9}, "camera": {"lookAt": {"eye": {"x": -1.5}}},
          "frames": [1, -2], "priority": -7, "title": null})",
      "job.json");
  ASSERT_TRUE(job.ok()) << job.status();
  EXPECT_EQ(job->settings().light_samples(), 3u);
  EXPECT_EQ(job->settings().tile_px(), 32u);
  EXPECT_EQ(job->settings().spp(), 4u);
  EXPECT_EQ(job->settings().seed(), 18446744073709551615u);
  EXPECT_EQ(job->settings().filter(), v1::PIXEL_FILTER_GAUSSIAN);
  EXPECT_EQ(job->film().height_px(), 9u);
  EXPECT_EQ(job->frames(1), -2);
  EXPECT_EQ(job->camera().look_at().eye().x(), -1.5);
}

TEST(JobFile, AnUnknownFieldIsNamedByItsPathWithTheNearestOne) {
  EXPECT_THAT(Refusal(R"({"settings": {"light_sampels": 3}})"),
              AllOf(StartsWith("'my.json' is not a job file: settings.light_sampels is not a known "
                               "field"),
                    HasSubstr("did you mean 'light_samples'?")));
  EXPECT_THAT(
      Refusal(R"({"overrides": {"lights": [{}, {"intensty": {}}]}})"),
      AllOf(HasSubstr("overrides.lights[1].intensty"), HasSubstr("did you mean 'intensity'?")));
  EXPECT_THAT(Refusal(R"({"camera": {"look_at": {"eye": {"X": 1}}}})"),
              AllOf(HasSubstr("camera.look_at.eye.X"), HasSubstr("did you mean 'x'?")));
  // A field of another message is not offered.
  EXPECT_THAT(Refusal(R"({"spp": 4})"), Not(HasSubstr("mean 'spp'")));
  EXPECT_THAT(Refusal(R"({"limits": {"zzzzzz": 4}})"), HasSubstr("known here: max_pixels, "));
}

TEST(JobFile, AWrongValueIsNamedWithWhatIsAllowed) {
  const struct {
    const char *text, *path, *value, *allowed;
  } cases[] = {
      {R"({"settings": {"spp": "many"}})", "settings.spp", "\"many\"", "0 to 4294967295"},
      {R"({"settings": {"spp": -1}})", "settings.spp", "-1", "0 to 4294967295"},
      {R"({"settings": {"spp": 1.5}})", "settings.spp", "1.5", "a whole number"},
      {R"({"settings": {"spp": 4294967296}})", "settings.spp", "4294967296", "4294967295"},
      {R"({"settings": {"seed": "18446744073709551616"}})", "settings.seed", "18446744073709551616",
       "18446744073709551615"},
      {R"({"settings": {"epsilon": "small"}})", "settings.epsilon", "small", "a finite number"},
      {R"({"settings": {"epsilon": 1e39}})", "settings.epsilon", "1e+39", "a finite number"},
      {R"({"settings": {"epsilon": "NaN"}})", "settings.epsilon", "NaN", "a finite number"},
      {R"({"settings": {"no_skip": 1}})", "settings.no_skip", "1", "true or false"},
      {R"({"settings": {"integrator": "fpbgi"}})", "settings.integrator", "\"fpbgi\"",
       "INTEGRATOR_FPBGI, INTEGRATOR_PBGI"},
      {R"({"settings": {"integrator": "integrator_fpbgy"}})", "settings.integrator", "fpbgy",
       "did you mean INTEGRATOR_FPBGI?"},
      {R"({"settings": {"integrator": 77}})", "settings.integrator", "77", "INTEGRATOR_PT"},
      {R"({"settings": {"integrator": 77777777777}})", "settings.integrator", "77777777777",
       "INTEGRATOR_PT"},
      {R"({"settings": 3})", "settings", "3", "an object with integrator, "},
      {R"({"settings": {"layers": "beauty"}})", "settings.layers", "\"beauty\"", "a list"},
      {R"({"settings": {"layers": ["beauty", 4]}})", "settings.layers[1]", "4", "a text"},
      {R"({"frames": [1, "two"]})", "frames[1]", "\"two\"", "a whole number"},
      {R"({"frames": [2147483648]})", "frames[0]", "2147483648", "2147483647"},
      {R"({"title": {"de": "x"}})", "title", "an object", "a text in quotes"},
      {R"({"film": []})", "film", "a list", "an object with width_px, height_px, crop"},
      {R"([1])", "the file's content", "a list", "an object with asset, "},
      {R"(3)", "the file's content", "3", "an object with asset, "},
  };
  for (const auto& c : cases) {
    EXPECT_THAT(Refusal(c.text),
                AllOf(StartsWith("'my.json' is not a job file: " + std::string(c.path) + " is "),
                      HasSubstr(c.value), HasSubstr("; allowed: "), HasSubstr(c.allowed)));
  }
  EXPECT_THAT(Refusal(R"({"camera": {"name": "a", "look_at": {}}})"),
              AllOf(HasSubstr("camera."), HasSubstr("exclude each other")));
}

TEST(JobFile, BadJsonIsNamedByItsPlace) {
  EXPECT_THAT(Refusal("{\n  \"settings\": {,}\n}"), HasSubstr("line 2"));
  for (const char* text : {"", "{", R"({"title": "x"} trailing)", "\xff\xfe",
                           "{\"title\": \"\xff\"}", R"({"settings": {"epsilon": 1e999}})"}) {
    Refusal(text);
  }
  // Deeper than any message: no stack is used up.
  Refusal(std::string(100'000, '['));
  Refusal("{\"title\": " + std::string(50'000, '[') + std::string(50'000, ']') + "}");
}

}  // namespace
}  // namespace farpoint
