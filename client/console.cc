#include "client/console.h"

#include <sys/ioctl.h>

#include <algorithm>
#include <cmath>

namespace farpoint {

absl::StatusOr<ConsoleLevel> ConsoleLevelFromName(std::string_view name) {
  constexpr std::pair<std::string_view, ConsoleLevel> kLevels[] = {{"debug", ConsoleLevel::kDebug},
                                                                   {"info", ConsoleLevel::kInfo},
                                                                   {"warn", ConsoleLevel::kWarn},
                                                                   {"error", ConsoleLevel::kError},
                                                                   {"off", ConsoleLevel::kOff}};
  for (const auto& [known, level] : kLevels) {
    if (name == known) return level;
  }
  return absl::InvalidArgumentError("expected one of debug, info, warn, error, off");
}

std::string DurationText(double seconds) {
  const auto whole = static_cast<long long>(std::llround(std::clamp(seconds, 0.0, 1e9)));
  char text[48];
  if (whole >= 3600) {
    std::snprintf(text, sizeof(text), "%lld:%02lld:%02lld", whole / 3600, whole / 60 % 60,
                  whole % 60);
  } else {
    std::snprintf(text, sizeof(text), "%lld:%02lld", whole / 60, whole % 60);
  }
  return text;
}

std::string ProgressText(const JobStatus& status, int columns, double in_state_s) {
  if (status.state == JobState::kQueued || status.state == JobState::kBaking ||
      (status.state == JobState::kPaused && status.tiles.committed == 0)) {
    std::string text(NameOf(status.state));
    if (in_state_s >= 1) text += ", " + DurationText(in_state_s);
    return text;
  }
  const double fraction = std::clamp(status.progress, 0.0, 1.0);
  char percent[16];
  std::snprintf(percent, sizeof(percent), "%3d %%", static_cast<int>(fraction * 100));
  std::string tail = percent;
  tail.append("  ").append(std::to_string(status.tiles.committed));
  tail.append("/").append(std::to_string(status.tiles.total)).append(" tiles");
  if (status.frames.total > 1) {
    tail.append("  ").append(std::to_string(status.frames.done));
    tail.append("/").append(std::to_string(status.frames.total)).append(" frames");
  }
  if (status.state == JobState::kPaused) tail += "  paused";
  if (status.reissued > 0) tail += "  " + std::to_string(status.reissued) + " again";
  if (status.eta_s && !IsFinal(status.state)) tail += "  eta " + DurationText(*status.eta_s);
  const int width = std::min(40, columns - static_cast<int>(tail.size()) - 5);
  if (width < 5) return tail;
  const int full = static_cast<int>(fraction * width);
  std::string bar = "[";
  bar.append(full, '#').append(width - full, '-').append("] ").append(tail);
  return bar;
}

namespace {

// Changes when the state does or another tenth is done.
std::string TenthOf(const JobStatus& status) {
  std::string report(NameOf(status.state));
  if (status.state == JobState::kRendering) {
    report += " " + std::to_string(static_cast<int>(status.progress * 10));
  }
  return report;
}

std::string StateText(const JobStatus& status) {
  std::string text(NameOf(status.state));
  if (status.tiles.total > 0) {
    text += ", " + std::to_string(status.tiles.committed) + " of " +
            std::to_string(status.tiles.total) + " tiles";
  }
  if (status.frames.total > 1) {
    text += ", " + std::to_string(status.frames.done) + " of " +
            std::to_string(status.frames.total) + " frames";
  }
  if (status.state == JobState::kRendering) {
    text +=
        ", " + std::to_string(static_cast<int>(std::clamp(status.progress, 0.0, 1.0) * 100)) + " %";
    if (status.eta_s) text += ", eta " + DurationText(*status.eta_s);
  }
  return text;
}

}  // namespace

Console::Console(std::FILE* stream, bool terminal, ConsoleLevel level, bool quiet)
    : stream_(stream), terminal_(terminal), level_(level), quiet_(quiet) {}

Console::~Console() { EraseBar(); }

void Console::EraseBar() {
  if (bar_drawn_) std::fputs("\r\x1b[K", stream_);
  bar_drawn_ = false;
}

int Console::Columns() const {
  winsize size{};
  if (::ioctl(::fileno(stream_), TIOCGWINSZ, &size) != 0 || size.ws_col == 0) return 79;
  return std::clamp<int>(size.ws_col - 1, 20, 200);
}

void Console::Write(ConsoleLevel level, std::string_view prefix, std::string_view text) {
  if (level < level_ || (quiet_ && level < ConsoleLevel::kWarn)) return;
  std::lock_guard lock(mutex_);
  EraseBar();
  // In one call, so that lines of several processes stay whole.
  const std::string line = "farpoint: " + std::string(prefix) + std::string(text) + "\n";
  std::fwrite(line.data(), 1, line.size(), stream_);
  std::fflush(stream_);
}

void Console::Progress(const JobStatus& status) {
  if (quiet_ || level_ > ConsoleLevel::kInfo) return;
  std::lock_guard lock(mutex_);
  if (terminal_) {
    std::string line = "\r";
    const auto now = std::chrono::steady_clock::now();
    if (state_ != status.state) {
      state_ = status.state;
      state_since_ = now;
    }
    const double in_state_s = std::chrono::duration<double>(now - state_since_).count();
    line.append(ProgressText(status, Columns(), in_state_s)).append("\x1b[K");
    std::fwrite(line.data(), 1, line.size(), stream_);
    bar_drawn_ = true;
  } else {
    const std::string report = TenthOf(status);
    if (report == last_report_) return;
    last_report_ = report;
    const std::string line = "farpoint: " + StateText(status) + "\n";
    std::fwrite(line.data(), 1, line.size(), stream_);
  }
  std::fflush(stream_);
}

void Console::Report(const JobStatus& status) {
  {
    std::lock_guard lock(mutex_);
    std::string& last = last_reports_[status.id];
    const std::string report = TenthOf(status);
    if (report == last) return;
    last = report;
  }
  Info("job " + status.id.value + " " + StateText(status));
}

}  // namespace farpoint
