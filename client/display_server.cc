#include "client/display_server.h"

#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cctype>
#include <cerrno>
#include <condition_variable>
#include <cstring>
#include <deque>
#include <map>
#include <mutex>
#include <optional>
#include <span>
#include <string_view>
#include <thread>
#include <utility>
#include <vector>

#include "client/tev_packet.h"
#include "core/base/status.h"
#include "proto/resolve.h"

namespace farpoint {
namespace {

using std::chrono::milliseconds;
using SteadyTime = std::chrono::steady_clock::time_point;

// How soon the thread sees that it shall end.
constexpr milliseconds kLook(50);

class Socket {
 public:
  Socket() = default;
  explicit Socket(int fd) : fd_(fd) {}
  Socket(Socket&& from) noexcept : fd_(std::exchange(from.fd_, -1)) {}
  Socket& operator=(Socket&& from) noexcept {
    std::swap(fd_, from.fd_);
    return *this;
  }
  ~Socket() {
    if (fd_ >= 0) ::close(fd_);
  }
  int fd() const { return fd_; }
  bool open() const { return fd_ >= 0; }
  void Close() { *this = Socket(); }

 private:
  int fd_ = -1;
};

std::string ErrorText(int error) {
  std::string text = std::strerror(error);
  if (!text.empty()) text[0] = static_cast<char>(std::tolower(static_cast<unsigned char>(text[0])));
  return text;
}

std::vector<std::string_view> ChannelsOf(std::span<const Layer> layers) {
  std::vector<std::string_view> channels;
  for (const Layer layer : layers) {
    const auto& names = InfoOf(layer).channels;
    channels.insert(channels.end(), names.begin(), names.end());
  }
  return channels;
}

// The pixels of `rect`, channel by channel.
std::vector<float> ValuesOf(const Film& film, const PixelRect& rect) {
  std::vector<float> values;
  const auto width = static_cast<size_t>(film.rect().width());
  for (const Layer layer : film.layers()) {
    for (size_t c = 0; c < InfoOf(layer).channels.size(); ++c) {
      const std::span<const float> plane = film.Plane(layer, static_cast<int>(c));
      for (int y = rect.y0; y < rect.y1; ++y) {
        const auto row = plane.subspan(static_cast<size_t>(y - film.rect().y0) * width +
                                           static_cast<size_t>(rect.x0 - film.rect().x0),
                                       static_cast<size_t>(rect.width()));
        values.insert(values.end(), row.begin(), row.end());
      }
    }
  }
  return values;
}

// A frame as the viewer knows it.
struct Image {
  std::string name;
  PixelRect crop;
  std::vector<std::string_view> channels;
  uint32_t first_tile = 0;
  std::vector<PixelRect> tiles;
  std::vector<bool> sent, waits;  // by tile of the frame
  bool created = false;
};

struct QueuedTile {
  uint32_t frame = 0, index = 0;  // of the frame
  std::vector<float> values;
};

struct WholeFrame {
  uint32_t frame = 0;
  Film film;
};

}  // namespace

// Shared with the thread, which may outlive the display while a name server does not answer.
struct DisplayServer::State {
  explicit State(DisplayOptions given) : options(std::move(given)) {}

  DisplayOptions options;  // `warn` is guarded by mutex
  std::atomic<bool> stop{false};
  std::mutex mutex;
  std::condition_variable changed;  // with mutex: any of the following
  std::map<uint32_t, Image> images;
  std::deque<uint32_t> shown;  // frames of which the viewer has an image, the oldest first
  std::deque<QueuedTile> queue;
  size_t queued_bytes = 0;
  std::shared_ptr<const WholeFrame> whole;
  bool sending = false;
  bool unreachable = false;  // the last attempt to connect failed
  bool given_up = false;
  bool ended = false;  // the thread is about to return

  // --- Any thread, with mutex -------------------------------------------------------------------

  Image& ImageOf(const JobInfo& info, uint32_t frame, std::span<const Layer> layers) {
    const auto [at, fresh] = images.try_emplace(frame);
    Image& image = at->second;
    if (!fresh) return image;
    image.name = options.name(info, frame);
    image.crop = info.spec.film.crop;
    image.channels = ChannelsOf(layers);
    const size_t count = info.tiles.size() / std::max<size_t>(1, info.frames.size());
    image.first_tile = static_cast<uint32_t>(frame * count);
    for (size_t i = 0; i < count; ++i) image.tiles.push_back(info.tiles[image.first_tile + i].rect);
    image.sent.resize(count);
    image.waits.resize(count);
    return image;
  }
  // Frames that nobody speaks of any more.
  void Prune() {
    std::erase_if(images, [this](const auto& entry) {
      const auto& [frame, image] = entry;
      return frame != whole->frame && std::find(shown.begin(), shown.end(), frame) == shown.end() &&
             std::find(image.waits.begin(), image.waits.end(), true) == image.waits.end();
    });
  }
  void Warn(const std::string& text) {
    if (!options.warn) return;
    options.warn("--display-server " + options.address + ": " + text);
    options.warn = nullptr;
  }
  void GiveUp(const std::string& text) {
    Warn(text);
    given_up = true;
    queue.clear();
    queued_bytes = 0;
    whole = nullptr;
    images.clear();
    changed.notify_all();
  }
  // The first tile of the whole frame that the viewer lacks.
  std::optional<uint32_t> Lacking() {
    if (whole == nullptr) return std::nullopt;
    const Image& image = images.at(whole->frame);
    for (uint32_t i = 0; i < image.tiles.size(); ++i) {
      if (!image.sent[i]) return i;
    }
    return std::nullopt;
  }
  bool HasWork() { return !given_up && (!queue.empty() || Lacking().has_value()); }

  // --- The thread -------------------------------------------------------------------------------

  absl::Status Wait(int fd, short events, SteadyTime end) {
    while (!stop) {
      pollfd polled{fd, events, 0};
      const int ready = ::poll(&polled, 1, static_cast<int>(kLook.count()));
      if (ready > 0) return absl::OkStatus();
      if (ready < 0 && errno != EINTR) return absl::UnavailableError(ErrorText(errno));
      if (std::chrono::steady_clock::now() >= end) {
        return absl::DeadlineExceededError("no answer");
      }
    }
    return absl::CancelledError("ends");
  }

  absl::StatusOr<Socket> ConnectTo(const addrinfo& address) {
    Socket socket(::socket(address.ai_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
    if (!socket.open()) return absl::UnavailableError(ErrorText(errno));
    const SteadyTime end = std::chrono::steady_clock::now() + options.connect_time;
    if (::connect(socket.fd(), address.ai_addr, address.ai_addrlen) != 0) {
      if (errno != EINPROGRESS) return absl::UnavailableError(ErrorText(errno));
      FP_RETURN_IF_ERROR(Wait(socket.fd(), POLLOUT, end));
      int error = 0;
      socklen_t size = sizeof(error);
      ::getsockopt(socket.fd(), SOL_SOCKET, SO_ERROR, &error, &size);
      if (error != 0) return absl::UnavailableError(ErrorText(error));
    }
    const int on = 1;
    ::setsockopt(socket.fd(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
    return socket;
  }

  absl::StatusOr<Socket> Connect() {
    FP_ASSIGN_OR_RETURN(const AddressList list, Resolve(options.address));
    absl::Status last = absl::UnavailableError("the host has no address");
    for (const addrinfo* address = list.get(); address != nullptr; address = address->ai_next) {
      auto socket = ConnectTo(*address);
      if (socket.ok()) return socket;
      last = socket.status();
    }
    return last;
  }

  absl::Status Send(const Socket& socket, std::span<const std::byte> bytes) {
    SteadyTime end = std::chrono::steady_clock::now() + options.stall_time;
    while (!bytes.empty()) {
      if (stop) return absl::CancelledError("ends");
      const ssize_t sent = ::send(socket.fd(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
      if (sent > 0) {
        bytes = bytes.subspan(static_cast<size_t>(sent));
        end = std::chrono::steady_clock::now() + options.stall_time;
      } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
        FP_RETURN_IF_ERROR(Wait(socket.fd(), POLLOUT, end));
      } else if (errno != EINTR) {
        return absl::UnavailableError(ErrorText(errno));
      }
    }
    return absl::OkStatus();
  }

  // A viewer says nothing, so what can be read is the end of the connection, or of no interest.
  static bool PeerClosed(const Socket& socket) {
    char bytes[256];
    while (true) {
      const ssize_t got = ::recv(socket.fd(), bytes, sizeof(bytes), MSG_DONTWAIT);
      if (got == 0) return true;
      if (got < 0) return errno != EAGAIN && errno != EWOULDBLOCK && errno != EINTR;
    }
  }

  // Sends the next tile. The lock is given up meanwhile.
  absl::Status SendNext(std::unique_lock<std::mutex>& lock, const Socket& socket) {
    QueuedTile tile;
    std::shared_ptr<const WholeFrame> source;
    if (!queue.empty()) {
      tile = std::move(queue.front());
      queue.pop_front();
      queued_bytes -= tile.values.size() * sizeof(float);
      images.at(tile.frame).waits[tile.index] = false;
      if (images.at(tile.frame).sent[tile.index]) return absl::OkStatus();
    } else if (const std::optional<uint32_t> lacking = Lacking()) {
      source = whole;
      tile.frame = whole->frame;
      tile.index = *lacking;
    } else {
      return absl::OkStatus();
    }
    const Image image = images.at(tile.frame);
    std::vector<std::string> closed;
    if (!image.created) {
      shown.push_back(tile.frame);
      while (shown.size() > std::max<size_t>(1, options.open_images)) {
        closed.push_back(images.at(shown.front()).name);
        shown.pop_front();
      }
    }
    lock.unlock();
    const PixelRect& rect = image.tiles[tile.index];
    if (source != nullptr) tile.values = ValuesOf(source->film, rect);
    const PixelRect place{rect.x0 - image.crop.x0, rect.y0 - image.crop.y0, rect.x1 - image.crop.x0,
                          rect.y1 - image.crop.y0};
    absl::Status status;
    for (const std::string& name : closed) {
      if (status.ok()) status = Send(socket, CloseImagePacket(name));
    }
    if (status.ok() && !image.created) {
      status = Send(socket, CreateImagePacket(image.name, image.crop.width(), image.crop.height(),
                                              image.channels));
    }
    if (status.ok()) {
      status = UpdateImagePackets(
          image.name, image.channels, place, tile.values,
          [&](std::span<const std::byte> packet) { return Send(socket, packet); });
    }
    lock.lock();
    const auto at = images.find(tile.frame);
    if (at != images.end() && status.ok()) at->second.created = at->second.sent[tile.index] = true;
    return status;
  }

  // A viewer that comes back knows nothing.
  void ForgetSent() {
    for (auto& [frame, image] : images) {
      image.created = false;
      std::fill(image.sent.begin(), image.sent.end(), false);
    }
    shown.clear();
  }

  void Run() {
    Socket socket;
    std::unique_lock lock(mutex);
    while (true) {
      changed.wait(lock, [this] { return stop || HasWork(); });
      if (stop) break;
      sending = true;
      if (socket.open() && PeerClosed(socket)) {
        socket.Close();
        ForgetSent();
      }
      if (!socket.open()) {
        lock.unlock();
        auto connected = Connect();
        lock.lock();
        if (stop) break;
        unreachable = !connected.ok();
        changed.notify_all();
        if (unreachable) {
          Warn("no viewer answers (" + std::string(connected.status().message()) +
               "); the render goes on, and the viewer is tried again");
          changed.wait_for(lock, options.retry_pause, [this] { return stop.load(); });
          continue;
        }
        socket = *std::move(connected);
      }
      const absl::Status status = SendNext(lock, socket);
      if (stop) break;
      if (absl::IsDeadlineExceeded(status)) {
        socket.Close();
        GiveUp("the viewer has taken nothing for " +
               std::to_string(std::max<int64_t>(1, options.stall_time.count() / 1000)) +
               " s; the render goes on without it");
      } else if (!status.ok()) {
        Warn("the viewer is gone (" + std::string(status.message()) +
             "); the render goes on, and the viewer is tried again");
        socket.Close();
        ForgetSent();
      }
      sending = false;
      changed.notify_all();
    }
    sending = false;
    ended = true;
    changed.notify_all();
  }
};

DisplayServer::DisplayServer(DisplayOptions options)
    : state_(std::make_shared<State>(std::move(options))) {
  std::thread([state = state_] { state->Run(); }).detach();
}

DisplayServer::~DisplayServer() {
  std::unique_lock lock(state_->mutex);
  state_->stop = true;
  state_->options.warn = nullptr;
  state_->changed.notify_all();
  // Only a name server can keep the thread for longer; it then ends by itself.
  state_->changed.wait_for(lock, 4 * kLook, [this] { return state_->ended; });
}

void DisplayServer::ShowTile(const JobInfo& info, uint32_t tile, const Film& film) {
  if (tile >= info.tiles.size() || info.tiles[tile].rect.empty() ||
      !film.rect().Contains(info.tiles[tile].rect) ||
      !info.spec.film.crop.Contains(info.tiles[tile].rect)) {
    return;
  }
  const PixelRect& rect = info.tiles[tile].rect;
  const uint32_t frame = info.tiles[tile].frame;
  {
    std::lock_guard lock(state_->mutex);
    if (state_->given_up) return;
    size_t channels = 0;
    for (const Layer layer : film.layers()) channels += InfoOf(layer).channels.size();
    const size_t bytes = static_cast<size_t>(rect.area()) * channels * sizeof(float);
    if (state_->queued_bytes + bytes > state_->options.queue_bytes) return;
    const Image& image = state_->ImageOf(info, frame, film.layers());
    const uint32_t index = tile - image.first_tile;
    if (index >= image.tiles.size() || image.sent[index] || image.waits[index]) return;
  }
  QueuedTile queued{.frame = frame, .values = ValuesOf(film, rect)};
  std::lock_guard lock(state_->mutex);
  if (state_->given_up) return;
  Image& image = state_->ImageOf(info, frame, film.layers());
  queued.index = tile - image.first_tile;
  image.waits[queued.index] = true;
  state_->queued_bytes += queued.values.size() * sizeof(float);
  state_->queue.push_back(std::move(queued));
  state_->changed.notify_all();
}

void DisplayServer::ShowFrame(const JobInfo& info, uint32_t frame, Film film) {
  if (frame >= info.frames.size() || film.rect() != info.spec.film.crop) return;
  std::lock_guard lock(state_->mutex);
  if (state_->given_up) return;
  state_->ImageOf(info, frame, film.layers());
  state_->whole = std::make_shared<const WholeFrame>(WholeFrame{frame, std::move(film)});
  state_->Prune();
  state_->changed.notify_all();
}

void DisplayServer::Finish() {
  std::unique_lock lock(state_->mutex);
  const bool done = state_->changed.wait_for(lock, state_->options.finish_time, [this] {
    return state_->ended || state_->given_up || state_->unreachable ||
           (!state_->sending && !state_->HasWork());
  });
  if (!done) state_->Warn("the viewer has not taken all of the image in time; it shows a part");
}

}  // namespace farpoint
