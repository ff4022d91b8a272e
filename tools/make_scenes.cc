// farpoint-make-scenes: writes the project's own scenes as glTF (scenes/README.md).
#include <CLI/CLI.hpp>
#include <cstdio>
#include <string>

#include "core/scene/procedural.h"

namespace {

constexpr int kPermanentFailure = 42;
constexpr int kTryAgain = 75;

int Write(const farpoint::Scene& scene, const std::string& path) {
  const absl::Status status = farpoint::WriteGltf(scene, path);
  if (status.ok()) return 0;
  std::fprintf(stderr, "farpoint-make-scenes: %s\n", std::string(status.message()).c_str());
  return absl::IsUnavailable(status) || absl::IsResourceExhausted(status) ? kTryAgain
                                                                          : kPermanentFailure;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Writes the project's own scenes as .gltf (with a .bin beside it) or .glb.");
  app.set_version_flag("--version", FARPOINT_VERSION);
  app.require_subcommand(1);
  std::string output;
  const auto add = [&](const char* name, const char* description) {
    CLI::App* command = app.add_subcommand(name, description);
    command->add_option("-o,--output", output, "The file to write, .gltf or .glb")->required();
    return command;
  };
  CLI::App* cornell = add("cornell", "The Cornell box as measured");
  CLI::App* gloss = add("gloss", "The Cornell box with a block of copper and a sphere of plastic");
  float roughness = 0.3f;
  gloss->add_option("--roughness", roughness, "Of both")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  CLI::App* furnace = add("furnace", "A closed box that glows");
  float rho = 0.5f, radiance = 1;
  furnace->add_option("--rho", rho, "Reflectance")
      ->check(CLI::Range(0.0, 1.0))
      ->capture_default_str();
  furnace->add_option("--radiance", radiance, "Emitted radiance in W/(m² sr)")
      ->check(CLI::Range(0.0, 1e9))
      ->capture_default_str();
  CLI::App* city = add("city", "A city of blocks x blocks");
  unsigned blocks = 8;
  uint64_t seed = 1;
  city->add_option("--blocks", blocks, "Blocks on a side")
      ->check(CLI::Range(1, 64))
      ->capture_default_str();
  city->add_option("--seed", seed, "Another seed, another city")->capture_default_str();
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& e) {
    return app.exit(e) == 0 ? 0 : 2;
  }
  if (cornell->parsed()) return Write(farpoint::MakeCornellBox(), output);
  if (gloss->parsed()) return Write(farpoint::MakeGlossyCornellBox(roughness), output);
  if (furnace->parsed()) return Write(farpoint::MakeFurnace(rho, radiance), output);
  return Write(farpoint::MakeCity(blocks, seed), output);
}
