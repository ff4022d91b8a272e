// A farm of real processes on loopback: the programs of the build's bin folder, a store and caches
// in a fresh folder, ports that the system chose.
#pragma once

#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/base/hash.h"
#include "core/image/film.h"
#include "tests/integration/process.h"

namespace farpoint {

// The folder of the programs under test, and of the project's scenes.
std::string BinFolder();
std::string SceneFile(const std::string& name);

struct RunResult {
  int exit_code = -1;  // -1: did not end in time
  std::string out, err;
};

class Farm {
 public:
  Farm();
  ~Farm();

  const std::string& folder() const { return folder_; }
  std::string File(const std::string& name) const { return folder_ + "/" + name; }
  std::string Write(const std::string& name, const std::string& text) const;
  std::string Read(const std::string& name) const;

  // Fails the test unless the coordinator listens within a few seconds. The first start chooses a
  // port; later ones use the same, and the same store.
  void StartServer(const std::vector<std::string>& flags = {});
  Process& server() { return *server_; }
  std::string address() const { return "127.0.0.1:" + std::to_string(port_); }

  // Returns its index.
  size_t StartWorker(int threads = 1, const std::vector<std::string>& flags = {});
  Process& worker(size_t i) { return *workers_[i]; }
  void StopWorkers();  // by SIGTERM; they have ended when this returns

  // Starts the client in the background, with --coordinator where `farm` says so.
  std::unique_ptr<Process> StartClient(const std::vector<std::string>& args,
                                       const std::string& name);
  // Runs it to its end.
  RunResult Client(const std::vector<std::string>& args,
                   std::chrono::milliseconds time = std::chrono::seconds(120));
  // args plus --coordinator of this farm.
  std::vector<std::string> WithCoordinator(std::vector<std::string> args) const;

  // `farpoint status`; empty if the coordinator did not answer.
  std::string Status(const std::string& job = "");
  // Everything that server and workers have written, for messages of failed tests.
  std::string Logs() const;

 private:
  std::string folder_;
  int port_ = 0;
  int runs_ = 0;
  std::unique_ptr<Process> server_;
  std::vector<std::unique_ptr<Process>> workers_;
};

// The hash that is in an image's header, after the pixels were hashed again and found to match it.
// Fails the test otherwise.
std::string ImageHashOf(const std::string& exr);
// The film that an image holds; fails the test if it is not one of ours.
Film FilmOf(const std::string& exr);
// The hash of a part of an image.
std::string CropHashOf(const std::string& exr, const PixelRect& crop);

}  // namespace farpoint
