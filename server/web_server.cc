#include "server/web_server.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>
#include <utility>
#include <vector>

#include "core/image/film.h"
#include "core/image/png_io.h"
#include "core/math/elementary.h"
#include "proto/access.h"
#include "server/web_files.h"

namespace farpoint {

namespace {

using Json = nlohmann::json;

constexpr char kStatus[] = "/farpoint.v1.JobService/Status";
constexpr char kFetch[] = "/farpoint.v1.JobService/FetchTiles";
// A page has no use for more tiles of a frame at a time.
constexpr size_t kMaxViewedTiles = 65536;
constexpr int kMaxShrink = 64;
constexpr double kMaxStops = 20;

std::string Dump(const Json& json) {
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

HttpResponse Answer(const Json& json) { return {200, "application/json", Dump(json)}; }

HttpResponse Refusal(const absl::Status& status) {
  const Json json = {{"error", std::string(status.message())}};
  return {HttpStatusOf(status), "application/json", Dump(json)};
}

// A whole number of [min, max]; `fallback` if `text` is empty.
absl::StatusOr<int64_t> NumberOf(const std::string& text, const char* name, int64_t min,
                                 int64_t max, int64_t fallback) {
  if (text.empty()) return fallback;
  int64_t value = 0;
  const char* const end = text.data() + text.size();
  const auto read = std::from_chars(text.data(), end, value);
  if (read.ec != std::errc() || read.ptr != end || value < min || value > max) {
    return absl::InvalidArgumentError(std::string(name) + " is not a number from " +
                                      std::to_string(min) + " to " + std::to_string(max));
  }
  return value;
}

Json ToJson(const JobStatus& job, const std::string& owner) {
  Json json = {
      {"id", job.id.value},
      {"title", job.title},
      {"state", NameOf(job.state)},
      {"progress", job.progress},
      {"tiles",
       {{"queued", job.tiles.queued},
        {"leased", job.tiles.leased},
        {"committed", job.tiles.committed},
        {"failed", job.tiles.failed},
        {"total", job.tiles.total}}},
      {"frames",
       {{"total", job.frames.total}, {"baked", job.frames.baked}, {"done", job.frames.done}}},
      {"priority", job.priority},
      {"submitted_unix_ms", job.submitted_unix_ms},
      {"reissued", job.reissued},
      {"refused_results", job.refused_results},
      {"owner", owner}};
  if (job.eta_s) json["eta_s"] = *job.eta_s;
  if (!job.error.ok()) json["error"] = std::string(job.error.message());
  return json;
}

Json ToJson(const WorkerStatus& worker) {
  return {{"id", worker.id.value},
          {"name", worker.name},
          {"threads", worker.threads},
          {"leases", worker.leases},
          {"committed", worker.committed},
          {"failures", worker.failures},
          {"set_aside", worker.set_aside},
          {"idle_s", worker.idle_s},
          {"gone", worker.gone}};
}

const char* NameOfState(TileView::State state) {
  switch (state) {
    case TileView::State::kQueued:
      return "queued";
    case TileView::State::kLeased:
      return "leased";
    case TileView::State::kCommitted:
      return "committed";
    case TileView::State::kFailed:
      break;
  }
  return "failed";
}

Json ToJson(const JobView& view, const std::string& owner) {
  Json tiles = Json::array();
  for (const TileView& tile : view.tiles) {
    const PixelRect& r = tile.rect;
    Json one = {{"rect", {r.x0, r.y0, r.x1, r.y1}}, {"state", NameOfState(tile.state)}};
    if (!tile.worker.empty()) one["worker"] = tile.worker;
    if (tile.state == TileView::State::kCommitted) {
      one["seconds"] = tile.seconds;
      if (tile.receivers > 0) one["receivers"] = tile.receivers;
      if (tile.clusters > 0) one["clusters"] = tile.clusters;
      if (tile.cut_nodes > 0) one["cut_nodes"] = tile.cut_nodes;
    }
    if (tile.state == TileView::State::kLeased) one["fraction"] = tile.fraction;
    if (tile.failures > 0) one["failures"] = tile.failures;
    tiles.push_back(std::move(one));
  }
  Json log = Json::array();
  for (const JobLogEntry& entry : view.log) {
    Json line = {
        {"unix_ms", entry.unix_ms}, {"level", NameOf(entry.line.level)}, {"text", entry.line.text}};
    if (entry.line.tile) line["tile"] = *entry.line.tile;
    if (entry.line.attempt != 0) line["attempt"] = entry.line.attempt;
    if (!entry.line.worker.empty()) line["worker"] = entry.line.worker;
    log.push_back(std::move(line));
  }
  return {{"job", ToJson(view.status, owner)},
          {"width", view.film.width},
          {"height", view.film.height},
          {"crop", {view.film.crop.x0, view.film.crop.y0, view.film.crop.x1, view.film.crop.y1}},
          {"frame_index", view.frame_index},
          {"frame_number", view.frame_number},
          {"first_tile", view.first_tile},
          {"tiles", std::move(tiles)},
          {"log", std::move(log)}};
}

// Mean of each shrink x shrink pixels, those at the edges of fewer, times 2^stops, as sRGB.
absl::StatusOr<std::string> Preview(const TileData& data, int shrink, double stops) {
  FP_ASSIGN_OR_RETURN(const Film film, DecodeFilm(data.bytes.bytes()));
  if (!film.Has(Layer::kBeauty)) {
    return absl::FailedPreconditionError("the job has no layer 'beauty' to show");
  }
  const int width = film.rect().width(), height = film.rect().height();
  const int small_width = (width + shrink - 1) / shrink,
            small_height = (height + shrink - 1) / shrink;
  const double scale = std::exp2(stops);
  std::vector<uint8_t> rgb(size_t{3} * small_width * small_height);
  for (int c = 0; c < 3; ++c) {
    const std::span<const float> plane = film.Plane(Layer::kBeauty, c);
    for (int y = 0; y < small_height; ++y) {
      for (int x = 0; x < small_width; ++x) {
        double sum = 0;
        int count = 0;
        for (int v = y * shrink; v < std::min(height, (y + 1) * shrink); ++v) {
          for (int u = x * shrink; u < std::min(width, (x + 1) * shrink); ++u, ++count) {
            sum += plane[static_cast<size_t>(v) * width + u];
          }
        }
        const double linear = std::clamp(scale * sum / count, 0.0, 1.0);
        rgb[3 * (static_cast<size_t>(y) * small_width + x) + c] =
            static_cast<uint8_t>(255.0 * LinearToSrgb(linear) + 0.5);
      }
    }
  }
  FP_ASSIGN_OR_RETURN(const std::vector<std::byte> png, EncodePng(small_width, small_height, rgb));
  return std::string(reinterpret_cast<const char*>(png.data()), png.size());
}

// "/api/jobs/ID/REST": what stands for ID and REST.
struct JobPath {
  JobId job;
  std::string rest;
};
std::optional<JobPath> SplitJobPath(const std::string& path) {
  constexpr std::string_view kPrefix = "/api/jobs/";
  if (!path.starts_with(kPrefix)) return std::nullopt;
  const size_t slash = path.find('/', kPrefix.size());
  JobPath split;
  split.job.value = path.substr(kPrefix.size(), slash - kPrefix.size());
  if (slash != std::string::npos) split.rest = path.substr(slash + 1);
  return split;
}

class Web {
 public:
  Web(WebServerOptions options, CoordinatorMeter& meter, GrpcServer& api)
      : options_(std::move(options)),
        only_here_(!options_.tls && IsLoopback(options_.address)),
        meter_(meter),
        api_(api) {}

  HttpResponse operator()(const HttpRequest& request) const {
    if (only_here_ && !IsLoopback(WithPort(request.Header("host")))) {
      return Refusal(absl::PermissionDeniedError("this server answers to localhost only"));
    }
    const bool post = request.method == "POST";
    if (request.path == "/metrics" && !post) {
      if (!options_.open_metrics) {
        const absl::StatusOr<Caller> caller = Admit(request, kStatus);
        if (!caller.ok()) return Refusal(caller.status());
      }
      return {200, kMetricsContentType,
              meter_.Metrics({.traffic = &api_.traffic(),
                              .connections = api_.connections(),
                              .refused = api_.refusals(),
                              .draining = api_.draining()})};
    }
    if (options_.page) {
      if (!post) {
        for (const WebFile& file : kWebFiles) {
          if (request.path == file.path) {
            return {200, std::string(file.type), std::string(file.contents)};
          }
        }
        if (request.path == "/api/overview") return Overview(request);
        if (const auto job = SplitJobPath(request.path)) return OfJob(request, *job);
      } else if (const auto job = SplitJobPath(request.path)) {
        return Change(request, *job);
      }
    }
    return Refusal(absl::NotFoundError("there is nothing at this path; docs/web.md lists all"));
  }

 private:
  // IsLoopback wants a port.
  static std::string WithPort(const std::string& host) {
    const size_t colon = host.rfind(':');
    const bool has_port = colon != std::string::npos && host.find(']', colon) == std::string::npos;
    return has_port ? host : host + ":80";
  }

  absl::StatusOr<Caller> Admit(const HttpRequest& request, std::string_view method) const {
    return api_.Admit(method, request.Header("authorization"));
  }

  HttpResponse Overview(const HttpRequest& request) const {
    const absl::StatusOr<Caller> caller = Admit(request, kStatus);
    if (!caller.ok()) return Refusal(caller.status());
    Json jobs = Json::array(), workers = Json::array();
    for (const JobStatus& job : meter_.Jobs()) jobs.push_back(ToJson(job, api_.OwnerOf(job.id)));
    for (const WorkerStatus& worker : meter_.Workers()) workers.push_back(ToJson(worker));
    return Answer({{"version", FARPOINT_VERSION},
                   {"caller", caller->name},
                   {"role", NameOf(caller->role)},
                   {"draining", api_.draining()},
                   {"jobs", std::move(jobs)},
                   {"workers", std::move(workers)}});
  }

  HttpResponse OfJob(const HttpRequest& request, const JobPath& path) const {
    const bool tile = path.rest.starts_with("tiles/");
    const absl::StatusOr<Caller> caller = Admit(request, tile ? kFetch : kStatus);
    if (!caller.ok()) return Refusal(caller.status());
    if (path.rest.empty()) {
      const auto frame = NumberOf(request.Query("frame"), "frame", 0, kMaxFrames, 0);
      if (!frame.ok()) return Refusal(frame.status());
      const auto view = meter_.View(path.job, static_cast<uint32_t>(*frame));
      if (!view.ok()) return Refusal(view.status());
      if (view->tiles.size() > kMaxViewedTiles) {
        return Refusal(absl::FailedPreconditionError(
            "the frame has more than " + std::to_string(kMaxViewedTiles) +
            " tiles, which is too many to show; `farpoint fetch` gets the image"));
      }
      return Answer(ToJson(*view, api_.OwnerOf(path.job)));
    }
    if (path.rest == "explain") {
      const auto explanation = meter_.Explain(path.job);
      if (!explanation.ok()) return Refusal(explanation.status());
      return Answer({{"lines", explanation->lines}});
    }
    if (tile && path.rest.ends_with(".png")) return TilePng(request, path);
    return Refusal(absl::NotFoundError("there is nothing at this path; docs/web.md lists all"));
  }

  HttpResponse TilePng(const HttpRequest& request, const JobPath& path) const {
    constexpr size_t kBefore = std::string_view("tiles/").size();
    const std::string digits = path.rest.substr(kBefore, path.rest.size() - kBefore - 4);
    const auto tile = NumberOf(digits, "the tile", 0, UINT32_MAX, -1);
    const auto shrink = NumberOf(request.Query("shrink"), "shrink", 1, kMaxShrink, 1);
    const auto stops = NumberOf(request.Query("stops"), "stops", -static_cast<int64_t>(kMaxStops),
                                static_cast<int64_t>(kMaxStops), 0);
    for (const absl::Status& status : {tile.status(), shrink.status(), stops.status()}) {
      if (!status.ok()) return Refusal(status);
    }
    if (*tile < 0) return Refusal(absl::InvalidArgumentError("the tile has no number"));
    const auto data = meter_.FetchTile(path.job, static_cast<uint32_t>(*tile));
    if (!data.ok()) return Refusal(data.status());
    absl::StatusOr<std::string> png =
        Preview(*data, static_cast<int>(*shrink), static_cast<double>(*stops));
    if (!png.ok()) return Refusal(png.status());
    return {200, "image/png", *std::move(png)};
  }

  HttpResponse Change(const HttpRequest& request, const JobPath& path) const {
    // A header that no page of another site can send without asking this server first: without TLS
    // there is no token that such a page would lack.
    if (request.Header("x-farpoint").empty()) {
      return Refusal(absl::PermissionDeniedError("changes need the header 'X-Farpoint: 1'"));
    }
    struct Action {
      std::string_view name, method;
    };
    static constexpr Action kActions[] = {
        {"pause", "/farpoint.v1.JobService/Pause"},
        {"resume", "/farpoint.v1.JobService/Resume"},
        {"cancel", "/farpoint.v1.JobService/Cancel"},
        {"requeue", "/farpoint.v1.JobService/Requeue"},
        {"requeue-all", "/farpoint.v1.JobService/Requeue"},
    };
    for (const Action& action : kActions) {
      if (path.rest != action.name) continue;
      const absl::Status done = [&]() -> absl::Status {
        FP_ASSIGN_OR_RETURN(const Caller caller, Admit(request, action.method));
        FP_RETURN_IF_ERROR(api_.MayChange(caller, path.job));
        if (path.rest == "pause") return meter_.Pause(path.job);
        if (path.rest == "resume") return meter_.Resume(path.job);
        if (path.rest == "cancel") return meter_.Cancel(path.job);
        return meter_.Requeue(path.job, /*all=*/path.rest == "requeue-all");
      }();
      return done.ok() ? Answer(Json::object()) : Refusal(done);
    }
    return Refusal(absl::NotFoundError("there is nothing at this path; docs/web.md lists all"));
  }

  const WebServerOptions options_;
  const bool only_here_;
  CoordinatorMeter& meter_;
  GrpcServer& api_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<HttpServer>> StartWebServer(WebServerOptions options,
                                                           CoordinatorMeter& meter,
                                                           GrpcServer& api) {
  HttpServerOptions http;
  http.address = options.address;
  http.tls = options.tls;
  auto web = std::make_shared<Web>(std::move(options), meter, api);
  return HttpServer::Start(std::move(http),
                           [web](const HttpRequest& request) { return (*web)(request); });
}

}  // namespace farpoint
