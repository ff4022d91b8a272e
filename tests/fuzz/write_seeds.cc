// farpoint-fuzz-seeds DIR: writes the seeds of each target to DIR/TARGET/, and prints the targets'
// names.
#include <cstdio>
#include <filesystem>
#include <string>

#include "core/base/blob.h"
#include "tests/fuzz/fuzz_target.h"

namespace farpoint {
namespace {

bool WriteSeeds(const std::filesystem::path& dir, std::span<const FuzzTarget> targets) {
  for (const FuzzTarget& target : targets) {
    const std::filesystem::path folder = dir / target.name;
    std::error_code error;
    std::filesystem::create_directories(folder, error);
    size_t count = 0;
    for (const FuzzBytes& seed : target.seeds()) {
      const std::string path = (folder / ("seed-" + std::to_string(count++))).string();
      if (const absl::Status status = WriteFileAtomically(path, seed); !status.ok()) {
        std::fprintf(stderr, "farpoint-fuzz-seeds: %s\n", std::string(status.message()).c_str());
        return false;
      }
    }
    std::printf("%s\n", std::string(target.name).c_str());
  }
  return true;
}

}  // namespace
}  // namespace farpoint

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fputs("usage: farpoint-fuzz-seeds DIR\n", stderr);
    return 2;
  }
  bool ok = farpoint::WriteSeeds(argv[1], farpoint::CoreFuzzTargets());
#ifdef FARPOINT_FUZZ_WIRE
  ok = ok && farpoint::WriteSeeds(argv[1], farpoint::WireFuzzTargets());
#endif
  return ok ? 0 : 75;
}
