#include "server/explanation.h"

#include <algorithm>
#include <cstdio>
#include <ctime>
#include <string>
#include <string_view>
#include <utility>

namespace farpoint {

namespace {

constexpr size_t kTilesShown = 5;

std::string Count(uint64_t n, const std::string& one, const std::string& many) {
  return std::to_string(n) + " " + (n == 1 ? one : many);
}

std::string Seconds(double s) {
  char text[32];
  if (s < 100) {
    std::snprintf(text, sizeof(text), "%.3g s", s);
  } else {
    std::snprintf(text, sizeof(text), "%.0f s", s);
  }
  return text;
}

std::string Percent(float fraction) {
  return std::to_string(static_cast<int>(fraction * 100)) + " %";
}

std::string Ordinal(size_t n) {
  const size_t tens = n % 100;
  const bool teen = tens >= 11 && tens <= 13;
  const char* const ending = teen          ? "th"
                             : n % 10 == 1 ? "st"
                             : n % 10 == 2 ? "nd"
                             : n % 10 == 3 ? "rd"
                                           : "th";
  return std::to_string(n) + ending;
}

std::string TimeText(int64_t unix_ms) {
  const std::time_t seconds = unix_ms / 1000;
  std::tm utc{};
  gmtime_r(&seconds, &utc);
  char text[32];
  std::strftime(text, sizeof(text), "%Y-%m-%d %H:%M:%S UTC", &utc);
  return text;
}

// "tile 5", or "tile 5 of frame 12" in an animation.
std::string TileText(const ExplanationFacts& facts, uint32_t tile) {
  std::string text = "tile " + std::to_string(tile);
  if (facts.spec.frames.empty() || facts.frame_tiles == 0) return text;
  const uint32_t index = tile / facts.frame_tiles;
  if (index >= facts.spec.frame_count()) return text;
  return text + " of frame " + std::to_string(facts.spec.frame_number(index));
}

std::string FrameText(const ExplanationFacts& facts, uint32_t index) {
  if (facts.spec.frames.empty()) return "the scene";
  return "frame " + std::to_string(facts.spec.frame_number(index));
}

std::string JobText(const JobStatus& status) {
  return "job " + status.id.value + " (" + std::string(NameOf(status.state)) + ", " +
         std::to_string(status.tiles.committed) + " of " + std::to_string(status.tiles.total) +
         " tiles, priority " + std::to_string(status.priority) + ")";
}

void ExplainState(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  const JobStatus& s = facts.status;
  std::string line = std::string(NameOf(s.state)) + ": " + std::to_string(s.tiles.committed) +
                     " of " + Count(s.tiles.total, "tile", "tiles") + " committed";
  if (s.tiles.leased > 0) line += ", " + std::to_string(s.tiles.leased) + " in work";
  if (s.tiles.queued > 0) line += ", " + std::to_string(s.tiles.queued) + " queued";
  if (s.tiles.failed > 0) line += ", " + std::to_string(s.tiles.failed) + " failed";
  if (s.frames.total > 1) {
    line += "; " + std::to_string(s.frames.done) + " of " + std::to_string(s.frames.total) +
            " frames done, " + std::to_string(s.frames.baked) + " baked";
  }
  lines.push_back(line + "; priority " + std::to_string(s.priority));
  if (s.suspect_tiles > 0) {
    lines.push_back(Count(s.suspect_tiles, "tile is", "tiles are") +
                    " of a worker that was found to return wrong pixels since: farpoint requeue " +
                    s.id.value + " renders them again");
  }
  if (!s.error.ok()) lines.push_back("it failed: " + std::string(s.error.message()));
  if (s.state == JobState::kFailed || s.state == JobState::kCancelled) {
    lines.push_back("farpoint requeue " + s.id.value + " goes on where it was");
  }
}

void ExplainWaiting(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  if (facts.draining) {
    lines.push_back("the coordinator is shutting down: it goes on after the next start");
  }
  if (facts.paused) {
    lines.push_back("paused: no tile is leased and no bake started; farpoint resume " +
                    facts.status.id.value + " goes on");
  }
  for (const auto& dependency : facts.waits_for) {
    lines.push_back("waits for " + (dependency.status ? JobText(*dependency.status)
                                                      : "job " + dependency.id.value +
                                                            ", which is not known (any more)"));
  }
}

void ExplainBake(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  if (facts.baking) {
    lines.push_back(FrameText(facts, facts.baking->frame_index) + " is being baked, for " +
                    Seconds(facts.baking->seconds));
  }
  if (facts.bake_place > 0) {
    std::string line = Ordinal(facts.bake_place) + " in the bake queue";
    if (facts.baked_first && *facts.baked_first != facts.status.id) {
      line += ", job " + facts.baked_first->value + " goes before";
    }
    lines.push_back(std::move(line));
  }
  if (facts.enough_baked) {
    lines.push_back("the next frames are baked when fewer tiles are queued");
  }
}

void ExplainWorkers(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  if (facts.workers.empty()) {
    lines.push_back("no worker is connected; start farpoint-worker --coordinator HOST:PORT");
    return;
  }
  size_t set_aside = 0, foreign = 0, gone = 0;
  for (const WorkerStatus& worker : facts.workers) {
    if (worker.gone) {
      ++gone;
    } else if (!facts.report.fingerprint.empty() &&
               worker.fingerprint != facts.report.fingerprint) {
      ++foreign;
    } else if (worker.set_aside) {
      ++set_aside;
    }
  }
  const size_t all = facts.workers.size() - gone;
  if (all == 0) {
    lines.push_back(Count(gone, "worker is", "workers are") +
                    " gone, killed or cut off, and no other one is there; start farpoint-worker "
                    "--coordinator HOST:PORT");
  } else if (foreign == all) {
    lines.push_back("none of " + Count(all, "worker", "workers") +
                    " computes as those that rendered its first tiles did (fingerprint " +
                    facts.report.fingerprint.Hex().substr(0, 12) +
                    "); connect such a worker, or farpoint requeue --all renders it anew");
  } else if (foreign + set_aside == all) {
    lines.push_back(Count(set_aside, "worker is", "workers are") +
                    " set aside for a while after failures in a row" +
                    (foreign > 0 ? ", the others have another fingerprint" : ""));
  } else if (foreign > 0) {
    lines.push_back(Count(foreign, "worker has", "workers have") +
                    " another fingerprint than its first tiles and get none of it");
  }
  if (facts.served_first) {
    lines.push_back(JobText(*facts.served_first) + " is served first: " +
                    Count(facts.served_first_tiles, "tile of it waits", "tiles of it wait"));
  }
}

void ExplainTiles(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  const auto& in_work = facts.report.in_work;
  for (size_t i = 0; i < std::min(kTilesShown, in_work.size()); ++i) {
    const TileInWork& tile = in_work[i];
    std::string line = TileText(facts, tile.grant.tile) + " is in work for " +
                       Seconds(tile.seconds) + ", " + Percent(tile.fraction) + ", on worker '" +
                       tile.worker_name + "'";
    if (tile.grant.attempt > 1) line += ", attempt " + std::to_string(tile.grant.attempt);
    if (tile.grant.speculative) line += ", a copy of a slow tile";
    lines.push_back(std::move(line));
  }
  const auto& troubled = facts.report.troubled;
  for (size_t i = 0; i < std::min(kTilesShown, troubled.size()); ++i) {
    const TroubledTile& tile = troubled[i];
    lines.push_back(TileText(facts, tile.tile) +
                    (tile.set_aside ? " is set aside, it failed " : " failed ") +
                    Count(tile.failures, "time", "times") + " on " +
                    Count(tile.workers, "worker", "workers") + ", lately: " + tile.cause);
  }
  if (facts.report.audits_done + facts.report.audits_differ > 0) {
    lines.push_back("audits: other workers rendered " +
                    Count(facts.report.audits_done, "tile", "tiles") + " again; " +
                    (facts.report.audits_differ == 0
                         ? std::string("all alike")
                         : std::to_string(facts.report.audits_differ) + " came out otherwise"));
  }
  for (const TileSeconds& tile : facts.slowest) {
    lines.push_back(TileText(facts, tile.tile) + " took " + Seconds(tile.seconds) +
                    " of thread time, one of the slowest");
  }
  for (const StoredEvent& event : facts.problems) {
    const auto* const line = std::get_if<LogLine>(&event.body);
    if (line == nullptr) continue;
    std::string text = TimeText(event.unix_ms) + ": ";
    if (line->tile) text += TileText(facts, *line->tile) + ": ";
    text += line->text;
    if (!line->worker.empty()) text += " (worker '" + line->worker + "')";
    lines.push_back(std::move(text));
  }
}

// "import 0.1 s, tree 2 s"; of the wall clock where it is known.
std::string StagesText(const Stats& stats) {
  std::string text;
  for (int i = 0; i < kStageCount; ++i) {
    const double seconds = stats.wall_seconds[i] > 0 ? stats.wall_seconds[i] : stats.seconds[i];
    if (seconds <= 0) continue;
    text += (text.empty() ? "" : ", ") + std::string(kStageNames[i]) + " " + Seconds(seconds);
  }
  return text;
}

// Why what a counter of `skipped` counts was not computed; empty: unknown to this version.
std::string_view WhySkipped(std::string_view counter) {
  constexpr std::pair<std::string_view, std::string_view> kWhy[] = {
      {"bake_stages", "an earlier bake had the same"},
      {"bakes_without_light", "nothing sends light"},
      {"black_hits", "what paths met reflects nothing"},
      {"black_receivers", "they reflect nothing"},
      {"blocks_without_gather", "no receiver of theirs shows indirect light"},
      {"blocks_without_receivers", "they see the background only"},
      {"clusters", "others serve their places well enough"},
      {"environment_terms", "there is no environment"},
      {"hits_read_from_surfels", "the light of surfels is known"},
      {"nodes_below_horizon", "below the horizons of all receivers of a cluster"},
      {"nodes_hidden", "behind full pixels"},
      {"nodes_invisible_side", "only sides within closed objects would be seen"},
      {"objects_kept", "their surfels are those of an earlier bake"},
      {"objects_repeated", "they lie exactly where others do"},
      {"pixels_hidden", "full already"},
      {"scene_broadcasts", "workers have the scene"},
      {"shadow_rays", "their lights cannot reach"},
      {"subtrees_hidden", "behind full pixels"},
      {"surfel_sides_black", "they reflect nothing"},
      {"surfel_sides_inside", "within closed objects that no light reaches"},
      {"surfels_kept", "of an earlier bake"},
      {"surfels_shaded_kept", "lit alike in an earlier bake"},
      {"textures", "no surface shows them, or another is the same"},
      {"unlit_receivers", "nothing sends light"},
  };
  for (const auto& [name, why] : kWhy) {
    if (name == counter) return why;
  }
  return {};
}

// A line for each counter that is not 0.
void ExplainSkipped(const Stats& stats, const std::string& of, std::string_view but,
                    std::vector<std::string>& lines) {
  for (const auto& [name, count] : stats.skipped) {
    if (name == but || count == 0) continue;
    const std::string_view why = WhySkipped(name);
    lines.push_back(of + ": skipped " + name + " " + std::to_string(count) +
                    (why.empty() ? "" : ": " + std::string(why)));
  }
}

void ExplainWork(const ExplanationFacts& facts, std::vector<std::string>& lines) {
  if (facts.status.frames.baked > 0) {
    const auto reused = facts.bake_stats.skipped.find("bake");
    const uint64_t reused_count = reused == facts.bake_stats.skipped.end() ? 0 : reused->second;
    const std::string computed = StagesText(facts.bake_stats);
    if (reused_count > 0) {
      lines.push_back("bake: " + std::to_string(reused_count) + " of " +
                      Count(facts.status.frames.baked, "frame", "frames") +
                      " taken from an earlier bake of the same scene");
    }
    if (!computed.empty()) lines.push_back("bake: computed " + computed);
    ExplainSkipped(facts.bake_stats, "bake", "bake", lines);
  }
  ExplainSkipped(facts.tile_stats, "tiles", "", lines);
}

}  // namespace

Explanation Explain(const ExplanationFacts& facts) {
  Explanation explanation;
  ExplainState(facts, explanation.lines);
  if (!IsFinal(facts.status.state)) {
    ExplainWaiting(facts, explanation.lines);
    ExplainBake(facts, explanation.lines);
    ExplainWorkers(facts, explanation.lines);
  }
  ExplainTiles(facts, explanation.lines);
  ExplainWork(facts, explanation.lines);
  return explanation;
}

}  // namespace farpoint
