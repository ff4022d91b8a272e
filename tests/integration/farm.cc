#include "tests/integration/farm.h"

#include <gtest/gtest.h>
#include <signal.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <regex>

#include "core/image/exr_io.h"

namespace farpoint {

using std::chrono::seconds;

namespace {

std::string ReadAll(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace

std::string BinFolder() { return FARPOINT_BIN_FOLDER; }
std::string SceneFile(const std::string& name) {
  return std::string(FARPOINT_SCENE_FOLDER) + "/" + name;
}

Farm::Farm() {
  std::string pattern = (std::filesystem::temp_directory_path() / "farpoint-XXXXXX").string();
  if (mkdtemp(pattern.data()) == nullptr) std::abort();
  folder_ = pattern;
}

Farm::~Farm() {
  workers_.clear();
  server_.reset();
  std::error_code ignored;
  std::filesystem::remove_all(folder_, ignored);
}

std::string Farm::Write(const std::string& name, const std::string& text) const {
  std::ofstream(File(name), std::ios::binary) << text;
  return File(name);
}

std::string Farm::Read(const std::string& name) const { return ReadAll(File(name)); }

void Farm::StartServer(const std::vector<std::string>& flags) {
  server_.reset();
  const std::string log = "server" + std::to_string(runs_++) + ".log";
  std::vector<std::string> args = {BinFolder() + "/farpoint-server", "--listen", address(),
                                   "--store", File("store")};
  args.insert(args.end(), flags.begin(), flags.end());
  server_ = std::make_unique<Process>(args, File(log), File(log));
  const std::regex listening(R"(listening on [^\s:]+:(\d+))");
  const bool up = WaitUntil(seconds(20), [&] {
    std::smatch match;
    const std::string text = Read(log);
    if (!std::regex_search(text, match, listening)) return !server_->Running();
    port_ = std::stoi(match[1]);
    return true;
  });
  ASSERT_TRUE(up && server_->Running() && port_ > 0) << Logs();
}

size_t Farm::StartWorker(int threads, const std::vector<std::string>& flags) {
  const std::string name = "worker" + std::to_string(runs_++);
  std::vector<std::string> args = {BinFolder() + "/farpoint-worker",
                                   "--coordinator",
                                   address(),
                                   "--cache",
                                   File(name + ".cache"),
                                   "--threads",
                                   std::to_string(threads)};
  args.insert(args.end(), flags.begin(), flags.end());
  workers_.push_back(std::make_unique<Process>(args, File(name + ".log"), File(name + ".log")));
  return workers_.size() - 1;
}

void Farm::StopWorkers() {
  for (const auto& worker : workers_) worker->Signal(SIGTERM);
  for (const auto& worker : workers_) {
    EXPECT_TRUE(worker->Wait(seconds(30)).has_value()) << "a worker ignores SIGTERM\n" << Logs();
  }
  workers_.clear();
}

std::unique_ptr<Process> Farm::StartClient(const std::vector<std::string>& args,
                                           const std::string& name) {
  std::vector<std::string> all = {BinFolder() + "/farpoint"};
  all.insert(all.end(), args.begin(), args.end());
  return std::make_unique<Process>(all, File(name + ".out"), File(name + ".err"));
}

RunResult Farm::Client(const std::vector<std::string>& args, std::chrono::milliseconds time) {
  const std::string name = "client" + std::to_string(runs_++);
  const std::unique_ptr<Process> process = StartClient(args, name);
  RunResult result;
  result.exit_code = process->Wait(time).value_or(-1);
  result.out = Read(name + ".out");
  result.err = Read(name + ".err");
  return result;
}

std::vector<std::string> Farm::WithCoordinator(std::vector<std::string> args) const {
  args.insert(args.end(), {"--coordinator", address()});
  return args;
}

std::string Farm::Status(const std::string& job) {
  std::vector<std::string> args = {"status"};
  if (!job.empty()) args.push_back(job);
  args.insert(args.end(), {"--json", "-", "--patience", "0", "--log-level", "off"});
  const RunResult result = Client(WithCoordinator(args), seconds(20));
  return result.exit_code == 0 ? result.out : std::string();
}

std::string Farm::Logs() const {
  std::string all;
  for (const auto& entry : std::filesystem::directory_iterator(folder_)) {
    if (entry.path().extension() != ".log") continue;
    all += "--- " + entry.path().filename().string() + "\n" + ReadAll(entry.path().string());
  }
  return all;
}

Film FilmOf(const std::string& exr) {
  const auto image = ReadExr(exr);
  EXPECT_TRUE(image.ok()) << image.status();
  if (!image.ok()) return {};
  auto film = FilmFromExr(*image);
  EXPECT_TRUE(film.ok()) << film.status();
  return film.ok() ? *std::move(film) : Film();
}

std::string ImageHashOf(const std::string& exr) {
  const auto image = ReadExr(exr);
  EXPECT_TRUE(image.ok()) << image.status();
  if (!image.ok()) return "";
  const auto in_header = image->metadata.strings.find("farpoint:imageHash");
  EXPECT_NE(in_header, image->metadata.strings.end());
  if (in_header == image->metadata.strings.end()) return "";
  EXPECT_EQ(ImageHash(FilmOf(exr)).Hex(), in_header->second) << exr;
  return in_header->second;
}

std::string CropHashOf(const std::string& exr, const PixelRect& crop) {
  const Film whole = FilmOf(exr);
  Film part(crop, {whole.layers().begin(), whole.layers().end()});
  part.Paste(whole);
  return ImageHash(part).Hex();
}

}  // namespace farpoint
