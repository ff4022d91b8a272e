// Walks folders of other people's scenes, the well-formed and the malformed: each file is imported
// and prepared in a process of its own with bounded memory and time, and either becomes a scene or
// is refused with the file, the place in it and what to do.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cctype>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <optional>
#include <regex>
#include <string>
#include <vector>

#include "core/base/executor.h"
#include "core/scene/asset.h"
#include "core/scene/importer.h"
#include "core/scene/prepared_scene.h"

namespace farpoint {
namespace {

constexpr rlim_t kMaxBytes = rlim_t{2} << 30;
constexpr unsigned kMaxSeconds = 60;

#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
constexpr bool kLimitMemory = false;  // the sanitizers reserve terabytes of addresses
#else
constexpr bool kLimitMemory = true;
#endif

struct Verdict {
  bool ended = false;  // by itself, within its limits
  bool is_scene = false;
  std::string text;  // the message of a refusal, or the count of triangles
};

absl::StatusOr<std::string> ReadScene(const std::string& path, std::optional<double> time_s) {
  FP_ASSIGN_OR_RETURN(const AssetBundle asset, CollectAsset(path));
  ImportOptions options;
  options.time_s = time_s;
  FP_ASSIGN_OR_RETURN(ImportedScene imported, ImportScene(asset, options));
  EnsureCameraAndLight(imported, /*light_chosen=*/false);
  Executor executor(1);
  FP_ASSIGN_OR_RETURN(const auto prepared, PreparedScene::Prepare(imported.scene, executor));
  return std::to_string(prepared->triangles().size());
}

// In a child process, so that neither a crash nor the limits concern this one.
Verdict Try(const std::string& path, std::optional<double> time_s) {
  int ends[2];
  EXPECT_EQ(pipe(ends), 0);
  const pid_t child = fork();
  if (child == 0) {
    close(ends[0]);
    if (kLimitMemory) {
      const rlimit limit = {kMaxBytes, kMaxBytes};
      setrlimit(RLIMIT_AS, &limit);
    }
    alarm(kMaxSeconds);
    const auto result = ReadScene(path, time_s);
    const std::string text =
        result.ok() ? "+" + *result : "-" + std::string(result.status().message());
    const ssize_t written = write(ends[1], text.data(), text.size());
    _exit(written == static_cast<ssize_t>(text.size()) ? 0 : 1);
  }
  close(ends[1]);
  Verdict verdict;
  char piece[4096];
  for (ssize_t n; (n = read(ends[0], piece, sizeof(piece))) > 0;) {
    verdict.text.append(piece, static_cast<size_t>(n));
  }
  close(ends[0]);
  int status = 0;
  waitpid(child, &status, 0);
  verdict.ended = WIFEXITED(status) && WEXITSTATUS(status) == 0 && !verdict.text.empty();
  if (!verdict.ended) {
    verdict.text = WIFSIGNALED(status) ? "signal " + std::to_string(WTERMSIG(status)) : "no answer";
    return verdict;
  }
  verdict.is_scene = verdict.text[0] == '+';
  verdict.text.erase(0, 1);
  return verdict;
}

std::vector<std::filesystem::path> ScenesIn(const std::filesystem::path& folder) {
  std::vector<std::filesystem::path> paths;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(folder)) {
    std::string extension = entry.path().extension().string();
    for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
    if (extension == ".gltf" || extension == ".glb" || extension == ".obj" || extension == ".ply") {
      paths.push_back(entry.path());
    }
  }
  std::sort(paths.begin(), paths.end());
  return paths;
}

// The file, the place (a line, a byte, a path in the JSON, a part by its number) and what to do.
void ExpectGoodRefusal(const std::string& text, const std::string& path) {
  const std::string file = std::filesystem::path(path).filename().string();
  EXPECT_NE(text.find(file), std::string::npos) << path << "\n" << text;
  static const std::regex kPlace(
      R"((line|byte|vertex|face|triangle) \d+|: /([A-Za-z]+(/|:|$))?|header|mesh \d+|image ')");
  EXPECT_TRUE(std::regex_search(text, kPlace)) << path << "\n" << text;
  static const std::regex kFix(
      R"((;|:) (.*)(correct|export|put|convert|save|split|make|rename|raise|decompress|copy|scale|triangulate|give))");
  EXPECT_TRUE(std::regex_search(text, kFix)) << path << "\n" << text;
}

const char* Folder() { return std::getenv("FARPOINT_SCENES"); }

void Walk(const std::filesystem::path& folder, bool all_are_scenes) {
  const auto paths = ScenesIn(folder);
  ASSERT_FALSE(paths.empty()) << folder;
  size_t scenes = 0;
  for (const auto& path : paths) {
    const bool is_gltf = path.extension() == ".gltf" || path.extension() == ".glb";
    for (const std::optional<double> time_s : {std::optional<double>(), std::optional(0.3)}) {
      if (time_s && !is_gltf) continue;
      const Verdict verdict = Try(path.string(), time_s);
      EXPECT_TRUE(verdict.ended) << path << ": " << verdict.text;
      if (!verdict.ended) continue;
      if (std::getenv("FARPOINT_VERBOSE") != nullptr && !time_s) {
        printf("%s %s: %s\n", verdict.is_scene ? "scene " : "REFUSE", path.filename().c_str(),
               verdict.text.c_str());
      }
      scenes += verdict.is_scene ? 1 : 0;
      if (all_are_scenes) {
        EXPECT_TRUE(verdict.is_scene) << path << ": " << verdict.text;
      } else if (!verdict.is_scene) {
        ExpectGoodRefusal(verdict.text, path.string());
      }
    }
  }
  EXPECT_GT(scenes, 0u);
}

TEST(ForeignScenes, MalformedOnesAreReadOrRefusedByFilePlaceAndFix) {
  if (Folder() == nullptr) GTEST_SKIP() << "FARPOINT_SCENES is not set";
  Walk(std::filesystem::path(Folder()) / "malformed", false);
}

TEST(ForeignScenes, WellFormedOnesAreRead) {
  if (Folder() == nullptr) GTEST_SKIP() << "FARPOINT_SCENES is not set";
  for (const auto& entry : std::filesystem::directory_iterator(Folder())) {
    if (!entry.is_directory() || entry.path().filename() == "malformed") continue;
    Walk(entry.path(), true);
  }
}

TEST(ForeignScenes, OtherFormatsAreRefusedByName) {
  if (Folder() == nullptr) GTEST_SKIP() << "FARPOINT_SCENES is not set";
  const auto path = std::filesystem::path(Folder()) / "cornell/mitsuba_cbox/cbox.xml";
  if (!std::filesystem::exists(path)) GTEST_SKIP() << path << " is not there";
  const Verdict verdict = Try(path.string(), std::nullopt);
  EXPECT_FALSE(verdict.is_scene);
  EXPECT_THAT(verdict.text, ::testing::AllOf(::testing::HasSubstr("cbox.xml"),
                                             ::testing::HasSubstr(".gltf, .glb, .obj and .ply")));
}

}  // namespace
}  // namespace farpoint
