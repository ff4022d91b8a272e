#include "bench/service_relay.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <deque>
#include <random>
#include <vector>

namespace farpoint {

namespace {

using Clock = std::chrono::steady_clock;

constexpr size_t kPiece = 1400;  // about a packet
constexpr size_t kMostInFlight = size_t{1} << 20;

sockaddr_in Loopback(int port) {
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  address.sin_port = htons(static_cast<uint16_t>(port));
  return address;
}

absl::Status SocketError(const char* what) {
  return absl::UnavailableError(std::string("relay: ") + what + ": " + std::strerror(errno));
}

}  // namespace

struct Relay::Link {
  int near = -1, far = -1;
  std::atomic<bool> broken = false;
  std::atomic<int> pumps = 2;  // that still run
  std::thread down, up;
};

absl::StatusOr<std::unique_ptr<Relay>> Relay::Start(int target_port, uint64_t seed,
                                                    const RelayFaults& faults) {
  const int listener = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (listener < 0) return SocketError("socket");
  sockaddr_in address = Loopback(0);
  socklen_t size = sizeof(address);
  if (::bind(listener, reinterpret_cast<sockaddr*>(&address), size) != 0 ||
      ::listen(listener, 512) != 0 ||
      ::getsockname(listener, reinterpret_cast<sockaddr*>(&address), &size) != 0) {
    const absl::Status error = SocketError("listen");
    ::close(listener);
    return error;
  }
  return std::unique_ptr<Relay>(
      new Relay(listener, ntohs(address.sin_port), target_port, seed, faults));
}

Relay::Relay(int listener, int port, int target_port, uint64_t seed, const RelayFaults& faults)
    : listener_(listener), port_(port), target_port_(target_port), seed_(seed), faults_(faults) {
  acceptor_ = std::thread([this] { Accept(); });
}

Relay::~Relay() {
  ending_ = true;
  acceptor_.join();
  ::close(listener_);
  ResetAll();
  for (const auto& link : links_) {
    link->down.join();
    link->up.join();
    ::close(link->near);
    ::close(link->far);
  }
}

void Relay::ResetAll() {
  std::lock_guard lock(mutex_);
  for (const auto& link : links_) link->broken = true;
}

void Relay::Accept() {
  while (!ending_) {
    pollfd poll{listener_, POLLIN, 0};
    const bool asked = ::poll(&poll, 1, 20) > 0;
    std::lock_guard lock(mutex_);
    // Those that have ended.
    std::erase_if(links_, [](const std::unique_ptr<Link>& link) {
      if (link->pumps > 0) return false;
      link->down.join();
      link->up.join();
      ::close(link->near);
      ::close(link->far);
      return true;
    });
    if (!asked) continue;
    auto link = std::make_unique<Link>();
    link->near = ::accept4(listener_, nullptr, nullptr, SOCK_CLOEXEC);
    if (link->near < 0) continue;
    link->far = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    const sockaddr_in address = Loopback(target_port_);
    if (link->far < 0 ||
        ::connect(link->far, reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0) {
      ::close(link->near);
      if (link->far >= 0) ::close(link->far);
      continue;
    }
    for (const int fd : {link->near, link->far}) {
      const int on = 1;
      ::setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
      ::fcntl(fd, F_SETFL, ::fcntl(fd, F_GETFL) | O_NONBLOCK);
    }
    const uint64_t number = ++accepted_;
    Link& made = *link;
    links_.push_back(std::move(link));
    made.down = std::thread(
        [this, &made, number] { Pump(made, made.far, made.near, true, seed_ + 2 * number); });
    made.up = std::thread(
        [this, &made, number] { Pump(made, made.near, made.far, false, seed_ + 2 * number + 1); });
  }
}

void Relay::Pump(Link& link, int from, int to, bool down, uint64_t seed) {
  struct Piece {
    Clock::time_point due;
    std::vector<char> bytes;
    size_t sent = 0;
  };
  std::mt19937_64 random(seed);
  std::uniform_real_distribution<double> chance(0, 1);
  std::deque<Piece> pieces;
  size_t in_flight = 0;
  Clock::time_point line_free = Clock::now();  // when the line has sent what it has
  bool ended = false;                          // by `from`
  std::vector<char> buffer(kPiece);
  while (!ending_ && !link.broken && !(ended && pieces.empty())) {
    if (silent_) {
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
      continue;
    }
    const auto now = Clock::now();
    const bool due = !pieces.empty() && pieces.front().due <= now;
    int wait_ms = 20;
    if (!pieces.empty() && !due) {
      wait_ms = static_cast<int>(std::clamp<int64_t>(
          std::chrono::ceil<std::chrono::milliseconds>(pieces.front().due - now).count(), 0, 20));
    }
    const bool reads = !ended && in_flight < kMostInFlight;
    pollfd polls[2] = {{reads ? from : -1, POLLIN, 0}, {due ? to : -1, POLLOUT, 0}};
    ::poll(polls, 2, wait_ms);
    if (reads && (polls[0].revents & (POLLIN | POLLHUP | POLLERR)) != 0) {
      const ssize_t n = ::recv(from, buffer.data(), buffer.size(), 0);
      if (n == 0 || (n < 0 && errno != EAGAIN && errno != EINTR)) ended = true;
      if (n > 0) {
        if (chance(random) < faults_.reset) break;
        Piece piece{.due = Clock::now() + faults_.delay,
                    .bytes = std::vector<char>(buffer.begin(), buffer.begin() + n)};
        if (chance(random) < faults_.stall) piece.due += faults_.stalled;
        if (faults_.bytes_per_second > 0) {
          const std::chrono::duration<double> takes(static_cast<double>(n) /
                                                    static_cast<double>(faults_.bytes_per_second));
          line_free = std::max(line_free, Clock::now()) +
                      std::chrono::duration_cast<Clock::duration>(takes);
          piece.due = std::max(piece.due, line_free);
        }
        if (!pieces.empty()) piece.due = std::max(piece.due, pieces.back().due);
        if (chance(random) < faults_.flip) {
          piece.bytes[random() % piece.bytes.size()] ^= static_cast<char>(1 << (random() % 8));
          ++flipped_;
        }
        in_flight += static_cast<size_t>(n);
        pieces.push_back(std::move(piece));
      }
    }
    while (!pieces.empty() && pieces.front().due <= Clock::now() && !silent_) {
      Piece& piece = pieces.front();
      const ssize_t n = ::send(to, piece.bytes.data() + piece.sent, piece.bytes.size() - piece.sent,
                               MSG_NOSIGNAL);
      if (n < 0) {
        if (errno != EAGAIN && errno != EINTR) ended = link.broken = true;
        break;
      }
      piece.sent += static_cast<size_t>(n);
      if (down) bytes_down_ += static_cast<uint64_t>(n);
      if (piece.sent < piece.bytes.size()) break;
      in_flight -= piece.bytes.size();
      pieces.pop_front();
    }
  }
  link.broken = true;
  const linger at_once{1, 0};  // RST, not FIN
  ::setsockopt(to, SOL_SOCKET, SO_LINGER, &at_once, sizeof(at_once));
  ::shutdown(to, SHUT_RDWR);
  ::shutdown(from, SHUT_RDWR);
  --link.pumps;
}

}  // namespace farpoint
