// A viewer for tests: takes the packets of tev's protocol on a loopback port, checks every byte of
// them, and keeps the images that they make. Knows nothing of the client's code.
#pragma once

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <map>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

namespace farpoint {

struct TevImage {
  int width = 0, height = 0;
  std::vector<std::string> channels;
  std::vector<float> values;  // channel by channel
  std::vector<int> writes;    // of each pixel
  bool Complete() const {
    return !writes.empty() &&
           std::all_of(writes.begin(), writes.end(), [](int count) { return count > 0; });
  }
};

struct TevListenerOptions {
  bool read = true;              // false: accepts, and takes nothing
  int hang_up_after = -1;        // packets of the first connection; -1: never
  int port = 0;                  // 0: any
  int receive_buffer_bytes = 0;  // 0: the system's
};

class TevListener {
 public:
  explicit TevListener(TevListenerOptions options = {}) : options_(options) {
    listen_ = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    const int on = 1;
    ::setsockopt(listen_, SOL_SOCKET, SO_REUSEADDR, &on, sizeof(on));
    if (options_.receive_buffer_bytes > 0) {
      ::setsockopt(listen_, SOL_SOCKET, SO_RCVBUF, &options_.receive_buffer_bytes, sizeof(int));
    }
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    address.sin_port = htons(static_cast<uint16_t>(options_.port));
    socklen_t size = sizeof(address);
    if (::bind(listen_, reinterpret_cast<sockaddr*>(&address), size) != 0 ||
        ::listen(listen_, 8) != 0 ||
        ::getsockname(listen_, reinterpret_cast<sockaddr*>(&address), &size) != 0) {
      std::abort();
    }
    port_ = ntohs(address.sin_port);
    thread_ = std::thread([this] { Run(); });
  }
  ~TevListener() {
    stop_ = true;
    thread_.join();
    ::close(listen_);
  }

  int port() const { return port_; }
  std::string address() const { return "127.0.0.1:" + std::to_string(port_); }

  // What was wrong with the first packet that was; empty: nothing.
  std::string fault() {
    std::lock_guard lock(mutex_);
    return fault_;
  }
  std::map<std::string, TevImage> images() {
    std::lock_guard lock(mutex_);
    return images_;
  }
  std::vector<std::string> closed() {
    std::lock_guard lock(mutex_);
    return closed_;
  }
  int connections() const { return connections_; }
  int packets() const { return packets_; }

 private:
  // Reads exactly `size` bytes; false at the connection's end or when the test ends.
  bool Read(int fd, void* data, size_t size) {
    auto* at = static_cast<char*>(data);
    while (size > 0) {
      pollfd polled{fd, POLLIN, 0};
      while (::poll(&polled, 1, 20) == 0) {
        if (stop_) return false;
      }
      const ssize_t got = ::recv(fd, at, size, 0);
      if (got <= 0) return false;
      at += got;
      size -= static_cast<size_t>(got);
    }
    return true;
  }

  void Run() {
    while (!stop_) {
      pollfd polled{listen_, POLLIN, 0};
      if (::poll(&polled, 1, 20) <= 0) continue;
      const int fd = ::accept(listen_, nullptr, nullptr);
      if (fd < 0) continue;
      const int connection = connections_++;
      if (options_.read) {
        Serve(fd, connection == 0 ? options_.hang_up_after : -1);
      } else {
        while (!stop_) ::usleep(20'000);
      }
      ::close(fd);
    }
  }

  void Serve(int fd, int hang_up_after) {
    while (hang_up_after-- != 0) {
      uint32_t length = 0;
      if (!Read(fd, &length, sizeof(length))) return;
      if (length < 5) return Fault("a length of " + std::to_string(length));
      std::vector<char> packet(length - 4);
      if (!Read(fd, packet.data(), packet.size())) return;
      std::lock_guard lock(mutex_);
      Take(packet);
      // Before anybody hears of the packet.
      if (hang_up_after == 0) ::shutdown(fd, SHUT_RDWR);
      ++packets_;
      if (!fault_.empty()) return;
    }
  }
  void Fault(const std::string& text) {
    std::lock_guard lock(mutex_);
    if (fault_.empty()) fault_ = text;
  }

  // With mutex_.
  void Take(const std::vector<char>& packet) {
    size_t at = 0;
    const auto fault = [&](const std::string& text) {
      if (fault_.empty()) fault_ = text + " at byte " + std::to_string(at);
    };
    const auto get = [&]<typename T>(T value) {
      if (packet.size() - at < sizeof(T)) {
        fault("too short");
        return value;
      }
      std::memcpy(&value, packet.data() + at, sizeof(T));
      at += sizeof(T);
      return value;
    };
    const auto text = [&] {
      std::string value;
      while (at < packet.size() && packet[at] != '\0') value += packet[at++];
      if (at == packet.size()) fault("a text without an end");
      ++at;
      return value;
    };
    const auto channels = [&] {
      const auto count = get(int32_t{});
      std::vector<std::string> names;
      if (count < 1 || count > 1000) fault("a number of channels");
      for (int32_t i = 0; i < count && fault_.empty(); ++i) names.push_back(text());
      return names;
    };

    const auto operation = get(uint8_t{});
    if (operation == 2) {
      const std::string name = text();
      if (at != packet.size()) fault("bytes after the end");
      if (images_.erase(name) != 1) fault("an image that is not there is closed");
      closed_.push_back(name);
      return;
    }
    if (operation != 4 && operation != 6) return fault("an operation");
    if (get(uint8_t{7}) != 0) return fault("the focus is taken");
    const std::string name = text();
    if (operation == 4) {
      TevImage image;
      image.width = get(int32_t{});
      image.height = get(int32_t{});
      image.channels = channels();
      if (at != packet.size()) fault("bytes after the end");
      if (image.width < 1 || image.height < 1) fault("a size");
      if (!fault_.empty()) return;
      const size_t area = static_cast<size_t>(image.width) * static_cast<size_t>(image.height);
      image.values.resize(area * image.channels.size());
      image.writes.resize(area);
      images_[name] = std::move(image);
      return;
    }
    const auto found = images_.find(name);
    if (found == images_.end()) return fault("an image that was not created is updated");
    TevImage& image = found->second;
    const std::vector<std::string> names = channels();
    const int x = get(int32_t{}), y = get(int32_t{}), w = get(int32_t{}), h = get(int32_t{});
    if (!fault_.empty()) return;
    if (x < 0 || y < 0 || w < 1 || h < 1 || w > image.width - x || h > image.height - y) {
      return fault("a rectangle outside the image");
    }
    const int64_t area = int64_t{w} * h;
    std::vector<int64_t> offsets, strides;
    for (size_t c = 0; c < names.size(); ++c) offsets.push_back(get(int64_t{}));
    for (size_t c = 0; c < names.size(); ++c) strides.push_back(get(int64_t{}));
    if (!fault_.empty()) return;
    int64_t floats = 0;
    for (size_t c = 0; c < names.size(); ++c) {
      if (offsets[c] < 0 || strides[c] < 1) return fault("an offset or a stride");
      floats = std::max(floats, offsets[c] + (area - 1) * strides[c] + 1);
    }
    if (packet.size() - at != static_cast<size_t>(floats) * 4) return fault("a number of values");
    for (size_t c = 0; c < names.size(); ++c) {
      const auto channel = std::find(image.channels.begin(), image.channels.end(), names[c]);
      if (channel == image.channels.end()) return fault("a channel that was not announced");
      const auto plane = static_cast<size_t>(channel - image.channels.begin());
      for (int64_t i = 0; i < area; ++i) {
        const size_t pixel = static_cast<size_t>(y + i / w) * static_cast<size_t>(image.width) +
                             static_cast<size_t>(x + i % w);
        std::memcpy(&image.values[plane * image.writes.size() + pixel],
                    packet.data() + at + 4 * (offsets[c] + i * strides[c]), 4);
        if (c == 0) ++image.writes[pixel];
      }
    }
    if (names.size() != image.channels.size()) fault("some channels only");
  }

  const TevListenerOptions options_;
  int listen_ = -1, port_ = 0;
  std::atomic<bool> stop_{false};
  std::atomic<int> connections_{0}, packets_{0};
  std::mutex mutex_;
  std::string fault_;
  std::map<std::string, TevImage> images_;
  std::vector<std::string> closed_;
  std::thread thread_;
};

}  // namespace farpoint
