#include "bench/rebake.h"

#include <absl/strings/str_format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <nlohmann/json.hpp>
#include <utility>

#include "bench/bench_scene.h"
#include "core/base/executor.h"
#include "core/render/bake.h"

namespace farpoint {

namespace {

constexpr Stage kStages[] = {Stage::kImport, Stage::kSample, Stage::kShade, Stage::kTree};

struct Hashes {
  Digest scene, topology, radiance;
  bool operator==(const Hashes&) const = default;
};

Hashes HashesOf(const BakedScene& baked) {
  return {baked.prepared_scene.Hash(), baked.tree_topology.Hash(), baked.tree_radiance.Hash()};
}

struct Timed {
  double seconds = 0;
  Stats stats;
  Hashes hashes;
};

// A rotation about y.
Affine Turned(const Affine& m, double cosine, double sine) {
  Affine turn;
  turn.column[0] = {cosine, 0, -sine};
  turn.column[2] = {sine, 0, cosine};
  Affine result = turn * m;
  result.translation = m.translation;
  return result;
}

class Rebake {
 public:
  Rebake(const RebakeOptions& options, const std::function<void(std::string_view)>& log)
      : options_(options), log_(log), executor_(options.threads) {
    settings_.points = options.quick ? 20'000 : options.points;
    settings_.light_samples = options.light_samples;
    settings_.seed = options.seed;
  }

  absl::StatusOr<RebakeReport> Run() {
    report_.options = options_;
    const auto start = std::chrono::steady_clock::now();
    FP_ASSIGN_OR_RETURN(BenchScene read,
                        MakeBenchScene(options_.scene, options_.quick, options_.changes));
    report_.import_s =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    base_ = std::move(read.scene);
    if (base_.instances.empty()) return absl::InvalidArgumentError("the scene has no objects");
    const size_t object = std::min<size_t>(options_.object, base_.instances.size() - 1);
    const std::string object_name =
        "object " + std::to_string(object) + " ('" + base_.instances[object].name + "')";

    Add("same", "nothing, or the camera only", base_);
    {
      Scene scene = base_;
      for (PunctualLight& light : scene.lights) light.intensity *= 0.5f;
      for (Material& material : scene.materials) material.emission *= 0.75f;
      scene.environment.sky *= 0.75f;
      Add("light colour", "lights, emitters and sky dimmed", scene);
    }
    {
      Scene scene = base_;
      for (PunctualLight& light : scene.lights) {
        light.position += Vec3d(0.01, 0.02, 0.03);
        light.direction = Normalize(light.direction + Vec3d(0.2, 0.05, -0.1));
      }
      Add("light moved", "punctual lights moved and turned", scene);
    }
    {
      Scene scene = base_;
      for (Material& material : scene.materials) material.base_color *= 0.75f;
      Add("material", "base colours darkened", scene);
    }
    {
      Scene scene = base_;
      scene.instances[object].world_from_mesh.translation += Vec3d(0.02, 0.01, 0.03);
      Add("object moved", object_name, scene);
    }
    {
      Scene scene = base_;
      Affine& m = scene.instances[object].world_from_mesh;
      m = Turned(m, 0.96, 0.28);
      Add("object turned", object_name, scene);
    }
    {
      Scene scene = base_;
      scene.instances.erase(scene.instances.begin() + static_cast<ptrdiff_t>(object));
      if (!scene.instances.empty()) Add("object removed", object_name, scene);
    }
    const uint32_t repeats = options_.quick ? 1 : options_.repeat;
    for (uint32_t i = 0; i < repeats; ++i) FP_RETURN_IF_ERROR(Round(i));
    for (const Change& change : changes_) report_.cases.push_back(Summary(change));
    report_.triangles = report_.cases.front().cold.counts["triangles"];
    report_.surfels = report_.cases.front().cold.counts["surfels"];
    return std::move(report_);
  }

 private:
  absl::StatusOr<Timed> BakeOnce(const Scene& scene, BakeCache& cache) {
    Timed timed;
    BakeOptions options;
    options.cache = &cache;
    const auto start = std::chrono::steady_clock::now();
    FP_ASSIGN_OR_RETURN(const BakedScene baked,
                        Bake(scene, settings_, executor_, timed.stats, options));
    timed.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    timed.hashes = HashesOf(baked);
    return timed;
  }

  struct Change {
    std::string name, what;
    Scene scene;
    std::vector<Timed> cold, warm;  // by round
  };

  void Add(const std::string& name, const std::string& what, const Scene& scene) {
    changes_.push_back({name, what, scene, {}, {}});
  }

  // Every change once. All follow the same first bake: what one leaves is of no use to another, as
  // they change different things.
  absl::Status Round(uint32_t round) {
    BakeCache filled(options_.cache_bytes);
    FP_ASSIGN_OR_RETURN(const Timed base, BakeOnce(base_, filled));
    base_topology_ = base.hashes.topology;
    for (Change& change : changes_) {
      log_("rebake: round " + std::to_string(round) + ", " + change.name);
      FP_ASSIGN_OR_RETURN(Timed warm, BakeOnce(change.scene, filled));
      BakeCache empty(options_.cache_bytes);
      FP_ASSIGN_OR_RETURN(Timed cold, BakeOnce(change.scene, empty));
      change.warm.push_back(std::move(warm));
      change.cold.push_back(std::move(cold));
      if (change.warm.back().hashes != change.cold.front().hashes ||
          change.cold.back().hashes != change.cold.front().hashes) {
        return absl::InternalError("'" + change.name +
                                   "': the warm bake's blobs are not those of the cold one");
      }
    }
    report_.cache_bytes_used = std::max(report_.cache_bytes_used, filled.size_bytes());
    return absl::OkStatus();
  }

  static const Timed& Median(const std::vector<Timed>& times) {
    std::vector<const Timed*> sorted;
    for (const Timed& t : times) sorted.push_back(&t);
    std::sort(sorted.begin(), sorted.end(),
              [](const Timed* a, const Timed* b) { return a->seconds < b->seconds; });
    return *sorted[sorted.size() / 2];
  }

  RebakeCase Summary(const Change& change) const {
    const Timed& cold = Median(change.cold);
    const Timed& warm = Median(change.warm);
    return {.name = change.name,
            .what = change.what,
            .cold_s = cold.seconds,
            .warm_s = warm.seconds,
            .cold = cold.stats,
            .warm = warm.stats,
            .topology_same_as_before = warm.hashes.topology == base_topology_};
  }

  const RebakeOptions& options_;
  const std::function<void(std::string_view)>& log_;
  Executor executor_;
  RenderSettings settings_;
  Scene base_;
  Digest base_topology_;
  std::vector<Change> changes_;
  RebakeReport report_;
};

nlohmann::ordered_json SecondsJson(const std::array<double, kStageCount>& seconds) {
  nlohmann::ordered_json json;
  for (const Stage stage : kStages) {
    const auto i = static_cast<size_t>(stage);
    json[kStageNames[i]] = seconds[i];
  }
  return json;
}

double Sum(const std::array<double, kStageCount>& seconds) {
  double sum = 0;
  for (const Stage stage : kStages) sum += seconds[static_cast<size_t>(stage)];
  return sum;
}

}  // namespace

absl::StatusOr<RebakeReport> RunRebake(const RebakeOptions& options,
                                       const std::function<void(std::string_view)>& log) {
  return Rebake(options, log).Run();
}

std::string RebakeJson(const RebakeReport& report) {
  nlohmann::ordered_json json;
  json["farpoint_version"] = FARPOINT_VERSION;
  json["scene"] = report.options.scene;
  json["triangles"] = report.triangles;
  json["surfels"] = report.surfels;
  json["light_samples"] = report.options.light_samples;
  json["threads"] = Executor(report.options.threads).threads();
  json["repeat"] = report.options.quick ? 1 : report.options.repeat;
  json["import_seconds"] = report.import_s;
  json["cache_bytes"] = report.cache_bytes_used;
  for (const RebakeCase& c : report.cases) {
    nlohmann::ordered_json entry;
    entry["name"] = c.name;
    entry["what"] = c.what;
    entry["cold_seconds"] = c.cold_s;
    entry["warm_seconds"] = c.warm_s;
    entry["cold_wall_seconds"] = SecondsJson(c.cold.wall_seconds);
    entry["warm_wall_seconds"] = SecondsJson(c.warm.wall_seconds);
    entry["cold_thread_seconds"] = SecondsJson(c.cold.seconds);
    entry["warm_thread_seconds"] = SecondsJson(c.warm.seconds);
    entry["warm_counts"] = c.warm.counts;
    entry["warm_skipped"] = c.warm.skipped;
    entry["topology_same_as_before"] = c.topology_same_as_before;
    json["cases"].push_back(std::move(entry));
  }
  return json.dump(2) + "\n";
}

std::string RebakeTable(const RebakeReport& report) {
  std::string text = absl::StrFormat(
      "%s: %d triangles, %d surfels, %d threads; blobs of warm bakes are those of cold ones\n\n"
      "%-16s %15s %15s %33s\n%-16s %7s %7s %7s %7s   %7s %7s %7s %7s   %9s %9s %s\n",
      report.options.scene, report.triangles, report.surfels,
      Executor(report.options.threads).threads(), "", "cold", "warm", "wall seconds of the stages",
      "change", "wall", "cpu", "wall", "cpu", "import", "sample", "shade", "tree", "kept",
      "shading", "topology");
  const auto add = [&text](const RebakeCase& c, const std::string& name, double warm_s,
                           const Stats& stats, const std::string& topology) {
    const auto seconds = [&stats](Stage s) { return stats.wall_seconds[static_cast<size_t>(s)]; };
    const auto skipped = [&stats](const char* key) -> uint64_t {
      const auto it = stats.skipped.find(key);
      return it == stats.skipped.end() ? 0 : it->second;
    };
    text += absl::StrFormat(
        "%-16s %7.2f %7.2f %7.2f %7.2f   %7.2f %7.2f %7.2f %7.2f   %9d %9d %s\n", name, c.cold_s,
        Sum(c.cold.seconds), warm_s, Sum(stats.seconds), seconds(Stage::kImport),
        seconds(Stage::kSample), seconds(Stage::kShade), seconds(Stage::kTree),
        skipped("surfels_kept"), skipped("surfels_shaded_kept"), topology);
  };
  if (!report.cases.empty()) {
    const RebakeCase& c = report.cases.front();
    add(c, "(cold)", c.cold_s, c.cold, "");
  }
  for (const RebakeCase& c : report.cases) {
    add(c, c.name, c.warm_s, c.warm, c.topology_same_as_before ? "same" : "new");
  }
  return text;
}

}  // namespace farpoint
