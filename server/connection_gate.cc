#include "server/connection_gate.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <map>
#include <mutex>
#include <string_view>
#include <thread>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/base/posix_file.h"
#include "proto/resolve.h"

namespace farpoint {

namespace {

using Clock = std::chrono::steady_clock;

constexpr int kBacklog = 1024;
constexpr int kMaxTold = 20;
constexpr std::chrono::seconds kTellPeriod{10};
constexpr std::chrono::milliseconds kSweepPeriod{1000};
// What a stranger in the clear may send before it is answered: its preface, settings and one
// request.
constexpr size_t kMaxStrangerBytes = size_t{32} << 10;
constexpr size_t kFrameHeadBytes = 9;

// RFC 9113, section 3.4.
constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
constexpr std::string_view kEmptySettings("\0\0\0\4\0\0\0\0\0", 9);
constexpr std::string_view kSettingsAck("\0\0\0\4\1\0\0\0\0", 9);
constexpr char kHeadersFrame = 1;
// RFC 8446, section 6: a fatal alert, protocol_version.
constexpr std::string_view kTlsAlert("\x15\x03\x03\x00\x02\x02\x46", 7);
constexpr std::string_view kNoTlsHere =
    "this coordinator speaks TLS; give --certs DIR, or --tls-ca and --token-file";
constexpr std::string_view kHttpAnswer =
    "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n\r\n"
    "This is the port of farpoint-server, which speaks gRPC: farpoint status --coordinator "
    "HOST:PORT\n";

std::string HostOf(const sockaddr_storage& address) {
  char text[INET6_ADDRSTRLEN] = "?";
  if (address.ss_family == AF_INET) {
    ::inet_ntop(AF_INET, &reinterpret_cast<const sockaddr_in&>(address).sin_addr, text,
                sizeof(text));
  } else if (address.ss_family == AF_INET6) {
    in6_addr v6 = reinterpret_cast<const sockaddr_in6&>(address).sin6_addr;
    // Whoever has one address of IPv6 has the 2^64 of its network.
    if (!IN6_IS_ADDR_V4MAPPED(&v6) && !IN6_IS_ADDR_LOOPBACK(&v6)) {
      std::memset(v6.s6_addr + 8, 0, 8);
    }
    ::inet_ntop(AF_INET6, &v6, text, sizeof(text));
  }
  std::string_view host = text;
  // The same machine over a socket of both families.
  if (host.starts_with("::ffff:")) host.remove_prefix(7);
  return std::string(host);
}

// HPACK, RFC 7541 section 6.2.2: a literal without indexing whose name and value are short and
// plain.
void AppendHeader(std::string& block, std::string_view name, std::string_view value) {
  block += '\0';
  block += static_cast<char>(name.size());
  block += name;
  block += static_cast<char>(value.size());
  block += value;
}

// The whole answer to the request on `stream`: trailers only, as gRPC has them for a call that
// failed.
std::string RefusalFrames(uint32_t stream) {
  std::string block = "\x88";  // :status 200, from the static table
  AppendHeader(block, "content-type", "application/grpc");
  AppendHeader(block, "grpc-status", "16");  // UNAUTHENTICATED
  static_assert(kNoTlsHere.size() < 127);
  AppendHeader(block, "grpc-message", kNoTlsHere);
  std::string frames;
  const auto append_head = [&](size_t size, char type, char flags, uint32_t id) {
    for (const int shift : {16, 8, 0}) frames += static_cast<char>(size >> shift);
    frames += type;
    frames += flags;
    for (const int shift : {24, 16, 8, 0}) frames += static_cast<char>(id >> shift);
  };
  append_head(block.size(), kHeadersFrame, 0x5, stream);  // END_HEADERS, END_STREAM
  frames += block;
  return frames;
}

// The first stream that a peer in the clear opened, 0 if it has not yet. Only the heads of frames
// are read.
uint32_t OpenedStream(std::string_view bytes) {
  bytes.remove_prefix(std::min(bytes.size(), kPreface.size()));
  while (bytes.size() >= kFrameHeadBytes) {
    const auto byte = [&](size_t i) {
      return static_cast<uint32_t>(static_cast<unsigned char>(bytes[i]));
    };
    const size_t size = byte(0) << 16 | byte(1) << 8 | byte(2);
    if (bytes[3] == kHeadersFrame) {
      return (byte(5) & 0x7f) << 24 | byte(6) << 16 | byte(7) << 8 | byte(8);
    }
    if (bytes.size() - kFrameHeadBytes < size) return 0;
    bytes.remove_prefix(kFrameHeadBytes + size);
  }
  return 0;
}

// Of the first TLS record, as far as it says.
size_t HelloBytes(std::string_view said) {
  constexpr size_t kRecordHead = 5;
  if (said.size() < kRecordHead) return kRecordHead;
  const size_t size = static_cast<size_t>(static_cast<unsigned char>(said[3])) << 8 |
                      static_cast<unsigned char>(said[4]);
  return kRecordHead + std::min<size_t>(size, size_t{16} << 10);
}

size_t AvailableBytes(int fd) {
  int bytes = 0;
  return ::ioctl(fd, FIONREAD, &bytes) == 0 && bytes > 0 ? static_cast<size_t>(bytes) : 0;
}

class Gate final : public ConnectionGate {
 public:
  explicit Gate(ConnectionGateOptions options) : options_(std::move(options)) {}
  ~Gate() override { Stop(); }

  absl::Status Listen() {
    const absl::StatusOr<AddressList> list = Resolve(options_.address, ResolveFor::kListening);
    if (!list.ok()) {
      return absl::UnavailableError("cannot listen on '" + options_.address +
                                    "': " + std::string(list.status().message()) +
                                    "; name an address of this machine");
    }
    absl::Status failed;
    for (const addrinfo* at = list->get(); at != nullptr; at = at->ai_next) {
      const absl::Status status = ListenOn(*at);
      if (!status.ok()) failed = status;
    }
    // A machine without IPv6 still has a localhost of both families; a port that is taken has not.
    if (listeners_.empty() || absl::IsAlreadyExists(failed)) {
      return absl::UnavailableError("cannot listen on '" + options_.address +
                                    "': " + std::string(failed.message()) +
                                    "; is the port taken, or the address not this machine's?");
    }
    epoll_ = Descriptor(::epoll_create1(EPOLL_CLOEXEC));
    wake_ = Descriptor(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
    if (!epoll_.valid() || !wake_.valid() || !Watch(wake_.get(), EPOLLIN)) {
      return FileError("cannot wait for connections on", options_.address, errno);
    }
    return absl::OkStatus();
  }

  void Start(Handover handover) override {
    handover_ = std::move(handover);
    for (const Descriptor& listener : listeners_) Watch(listener.get(), EPOLLIN);
    thread_ = std::thread([this] { Loop(); });
  }

  void Stop() override {
    if (!thread_.joinable()) return;
    const uint64_t one = 1;
    (void)!::write(wake_.get(), &one, sizeof(one));
    thread_.join();
    listeners_.clear();
  }

  int port() const override { return port_; }
  size_t connections() override {
    std::lock_guard lock(mutex_);
    Sweep();
    return open_.size() + strangers_;
  }

 private:
  // A peer that has not said yet what it speaks, or is being refused.
  struct Stranger {
    Descriptor fd;
    std::string host;
    Clock::time_point until;
    std::string said;        // of one that is answered in HTTP/2
    bool answering = false;  // it got our settings, and an answer follows its request
  };
  // A connection that was handed on is over when its descriptor is closed, or is somebody else's:
  // no two open sockets have one inode.
  struct Open {
    ino_t inode;
    std::string host;
  };

  absl::Status ListenOn(const addrinfo& at) {
    Descriptor fd(::socket(at.ai_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
    if (!fd.valid()) return absl::UnavailableError(std::strerror(errno));
    const int on = 1, off = 0;
    ::setsockopt(fd.get(), SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
    sockaddr_storage address{};
    std::memcpy(&address, at.ai_addr, at.ai_addrlen);
    if (at.ai_family == AF_INET6) {
      auto& v6 = reinterpret_cast<sockaddr_in6&>(address);
      // All of [::] are both families; of a name each family has an address of its own.
      const bool any = std::memcmp(&v6.sin6_addr, &in6addr_any, sizeof(in6addr_any)) == 0;
      ::setsockopt(fd.get(), IPPROTO_IPV6, IPV6_V6ONLY, any ? &off : &on, sizeof(on));
      if (port_ != 0) v6.sin6_port = htons(static_cast<uint16_t>(port_));
    } else if (port_ != 0) {
      reinterpret_cast<sockaddr_in&>(address).sin_port = htons(static_cast<uint16_t>(port_));
    }
    if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), at.ai_addrlen) != 0 ||
        ::listen(fd.get(), kBacklog) != 0) {
      if (errno == EADDRINUSE) return absl::AlreadyExistsError(std::strerror(errno));
      return absl::UnavailableError(std::strerror(errno));
    }
    socklen_t size = sizeof(address);
    ::getsockname(fd.get(), reinterpret_cast<sockaddr*>(&address), &size);
    port_ = ntohs(address.ss_family == AF_INET6 ? reinterpret_cast<sockaddr_in6&>(address).sin6_port
                                                : reinterpret_cast<sockaddr_in&>(address).sin_port);
    listeners_.push_back(std::move(fd));
    return absl::OkStatus();
  }

  bool Watch(int fd, uint32_t events) {
    epoll_event event{};
    event.events = events;
    event.data.fd = fd;
    return ::epoll_ctl(epoll_.get(), EPOLL_CTL_ADD, fd, &event) == 0;
  }

  void Loop() {
    epoll_event events[64];
    bool paused = false;  // no descriptors are left
    for (;;) {
      const int count = ::epoll_wait(epoll_.get(), events, 64, 250);
      for (int i = 0; i < count; ++i) {
        const int fd = events[i].data.fd;
        if (fd == wake_.get()) {
          std::lock_guard lock(mutex_);
          waiting_.clear();
          strangers_ = 0;
          return;
        }
        const auto at = waiting_.find(fd);
        if (at != waiting_.end()) {
          Hear(at->second);
        } else if (IsListener(fd)) {
          paused = !AcceptAll(fd);
        }
      }
      DropLate();
      // Without this an accept that fails for want of descriptors would spin.
      if (paused) std::this_thread::sleep_for(std::chrono::milliseconds(50));
      paused = false;
      std::lock_guard lock(mutex_);
      strangers_ = waiting_.size();
    }
  }

  bool IsListener(int fd) const {
    return std::any_of(listeners_.begin(), listeners_.end(),
                       [fd](const Descriptor& one) { return one.get() == fd; });
  }

  // False if descriptors ran out.
  bool AcceptAll(int listener) {
    for (int i = 0; i < 64; ++i) {
      sockaddr_storage address{};
      socklen_t size = sizeof(address);
      Descriptor fd(::accept4(listener, reinterpret_cast<sockaddr*>(&address), &size,
                              SOCK_NONBLOCK | SOCK_CLOEXEC));
      if (!fd.valid()) {
        if (errno == EINTR || errno == ECONNABORTED) continue;
        if (errno == EAGAIN || errno == EWOULDBLOCK) return true;
        Tell("connections wait: " + std::string(std::strerror(errno)) +
             "; raise the limit of open files (ulimit -n)");
        return false;
      }
      std::string host = HostOf(address);
      if (!HasRoom(host)) continue;  // closed
      const int on = 1;
      ::setsockopt(fd.get(), IPPROTO_TCP, TCP_NODELAY, &on, sizeof(on));
      const int number = fd.get();
      if (!Watch(number, EPOLLIN)) continue;
      {
        std::lock_guard lock(mutex_);
        ++per_host_[host];
      }
      waiting_[number] = {.fd = std::move(fd),
                          .host = std::move(host),
                          .until = Clock::now() + options_.patience,
                          .said = {}};
    }
    return true;
  }

  bool HasRoom(const std::string& host) {
    std::lock_guard lock(mutex_);
    const auto used = [&] {
      const auto at = per_host_.find(host);
      return at == per_host_.end() ? size_t{0} : at->second;
    };
    const auto full = [&] {
      return open_.size() + waiting_.size() >= options_.max_connections ||
             used() >= options_.max_per_host;
    };
    if (full() || Clock::now() >= next_sweep_) Sweep();
    if (!full()) return true;
    if (used() >= options_.max_per_host) {
      Tell("refused a connection of " + host + ": " + std::to_string(used()) +
           " are open from there; see --max-connections-per-host");
    } else {
      Tell("refused a connection of " + host + ": " +
           std::to_string(open_.size() + waiting_.size()) + " are open; see --max-connections");
    }
    return false;
  }

  // Under mutex_. Forgets what was closed.
  void Sweep() {
    next_sweep_ = Clock::now() + kSweepPeriod;
    for (auto at = open_.begin(); at != open_.end();) {
      struct stat facts {};
      const bool same = ::fstat(at->first, &facts) == 0 && S_ISSOCK(facts.st_mode) &&
                        facts.st_ino == at->second.inode;
      if (same) {
        ++at;
      } else {
        Leave(at->second.host);
        at = open_.erase(at);
      }
    }
  }
  void Leave(const std::string& host) {
    const auto at = per_host_.find(host);
    if (at != per_host_.end() && --at->second == 0) per_host_.erase(at);
  }

  void Forget(int fd) {
    const auto at = waiting_.find(fd);
    ::epoll_ctl(epoll_.get(), EPOLL_CTL_DEL, fd, nullptr);
    std::lock_guard lock(mutex_);
    Leave(at->second.host);
    waiting_.erase(at);
  }

  // Something can be read from it.
  void Hear(Stranger& peer) {
    const int fd = peer.fd.get();
    if (peer.answering) return Answer(peer);
    char bytes[kPreface.size()];
    const ssize_t size = ::recv(fd, bytes, sizeof(bytes), MSG_PEEK);
    if (size < 0 && (errno == EINTR || errno == EAGAIN || errno == EWOULDBLOCK)) return;
    if (size <= 0) return Forget(fd);
    const std::string_view said(bytes, static_cast<size_t>(size));
    const bool tls = said[0] == 0x16;
    const bool http2 = kPreface.starts_with(said);
    if (options_.tls ? tls : http2) {
      // Not before all of its first words are there: who dribbles them waits here, where it is
      // cheap.
      const size_t whole = tls ? HelloBytes(said) : kPreface.size();
      if (AvailableBytes(fd) >= whole) return LetIn(fd);
      const int wanted = static_cast<int>(whole);
      ::setsockopt(fd, SOL_SOCKET, SO_RCVLOWAT, &wanted, sizeof(wanted));
      return;
    }
    if (tls) {
      return Refuse(peer, "speaks TLS, this coordinator does not", kTlsAlert);
    }
    if (!http2) {
      const bool http1 = said.find("HTTP/1") != std::string_view::npos ||
                         said.starts_with("GET ") || said.starts_with("POST ") ||
                         said.starts_with("HEAD ") || said.starts_with("OPTIONS ");
      return Refuse(peer, http1 ? "speaks HTTP/1, not gRPC" : "speaks neither TLS nor gRPC",
                    http1 ? kHttpAnswer : std::string_view());
    }
    // gRPC sends its request once it has seen settings; then the answer can be one that it shows.
    peer.answering = true;
    (void)::send(fd, kEmptySettings.data(), kEmptySettings.size(), MSG_NOSIGNAL);
    Answer(peer);
  }

  void Answer(Stranger& peer) {
    const int fd = peer.fd.get();
    char bytes[2048];
    for (;;) {
      const ssize_t size = ::recv(fd, bytes, sizeof(bytes), 0);
      if (size < 0 && errno == EINTR) continue;
      if (size < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) return;
      if (size <= 0) return Forget(fd);
      peer.said.append(bytes, static_cast<size_t>(size));
      if (const uint32_t stream = OpenedStream(peer.said); stream != 0) {
        std::string answer(kSettingsAck);
        answer += RefusalFrames(stream);
        return Refuse(peer, "does not speak TLS", answer);
      }
      if (peer.said.size() > kMaxStrangerBytes) return Refuse(peer, "does not speak TLS", {});
    }
  }

  void Refuse(Stranger& peer, std::string_view why, std::string_view answer) {
    Tell("refused a connection of " + peer.host + ": it " + std::string(why));
    const int fd = peer.fd.get();
    if (!answer.empty()) {
      (void)::send(fd, answer.data(), answer.size(), MSG_NOSIGNAL);
      // Closing with bytes unread would reset the connection and take the answer away.
      ::shutdown(fd, SHUT_WR);
      char rest[4096];
      for (int i = 0; i < 16 && ::recv(fd, rest, sizeof(rest), 0) > 0; ++i) {
      }
    }
    Forget(fd);
  }

  void LetIn(int fd) {
    const auto at = waiting_.find(fd);
    ::epoll_ctl(epoll_.get(), EPOLL_CTL_DEL, fd, nullptr);
    struct stat facts {};
    {
      std::lock_guard lock(mutex_);
      if (::fstat(fd, &facts) == 0) {
        // A descriptor that was closed unseen and is this one now.
        if (const auto old = open_.find(fd); old != open_.end()) Leave(old->second.host);
        open_[fd] = {facts.st_ino, at->second.host};
      }
    }
    Descriptor owned = std::move(at->second.fd);
    waiting_.erase(at);
    const int one = 1;
    ::setsockopt(fd, SOL_SOCKET, SO_RCVLOWAT, &one, sizeof(one));
    handover_(owned.Release());
  }

  void DropLate() {
    const auto now = Clock::now();
    if (now < next_drop_) return;
    next_drop_ = now + std::chrono::milliseconds(250);
    std::vector<int> late;
    for (const auto& [fd, peer] : waiting_) {
      if (now >= peer.until) late.push_back(fd);
    }
    if (late.empty()) return;
    Tell("closed " + std::to_string(late.size()) +
         " connections that did not say in time what they "
         "want, one of " +
         waiting_.at(late[0]).host);
    for (const int fd : late) Forget(fd);
  }

  void Tell(std::string text) {
    if (!options_.refused) return;
    const auto now = Clock::now();
    if (now - telling_since_ >= kTellPeriod) {
      telling_since_ = now;
      told_ = 0;
    }
    if (++told_ <= kMaxTold) options_.refused(std::move(text));
  }

  const ConnectionGateOptions options_;
  Handover handover_;
  int port_ = 0;
  std::vector<Descriptor> listeners_;
  Descriptor epoll_, wake_;
  std::thread thread_;
  // Of the loop alone.
  std::unordered_map<int, Stranger> waiting_;
  Clock::time_point next_drop_{};
  int told_ = 0;
  Clock::time_point telling_since_{};

  std::mutex mutex_;
  std::unordered_map<int, Open> open_;                   // guarded by mutex_, as all below
  std::map<std::string, size_t, std::less<>> per_host_;  // open and waiting
  size_t strangers_ = 0;                                 // of waiting_, for connections()
  Clock::time_point next_sweep_{};
};

}  // namespace

absl::StatusOr<std::unique_ptr<ConnectionGate>> ConnectionGate::Listen(
    ConnectionGateOptions options) {
  auto gate = std::make_unique<Gate>(std::move(options));
  FP_RETURN_IF_ERROR(gate->Listen());
  return gate;
}

}  // namespace farpoint
