// Shows images in a viewer that speaks tev's protocol (tev_packet.h) while their tiles arrive.
//
// The viewer has no say in a render: what is to be shown waits in a queue of bounded size, and a
// thread of this class sends it. A viewer that is not there is tried again, and gets what it missed
// of a frame when that is complete; one that takes nothing for a while is given up. Of all that the
// user hears once.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <string>

#include "core/image/film.h"
#include "proto/job.h"

namespace farpoint {

struct DisplayOptions {
  std::string address;  // HOST:PORT
  // The viewer's name for the image of a frame, an index into info.frames.
  std::function<std::string(const JobInfo& info, uint32_t frame)> name;
  // Called at most once, from any thread, and not after the destructor has returned.
  std::function<void(const std::string& text)> warn;

  size_t queue_bytes = size_t{64} << 20;  // of pixels that wait; tiles beyond it are left out
  size_t open_images = 8;                 // of a sequence; older ones are closed
  std::chrono::milliseconds connect_time{3000};
  std::chrono::milliseconds retry_pause{500};
  std::chrono::milliseconds stall_time{5000};   // without a byte taken: given up
  std::chrono::milliseconds finish_time{3000};  // what Finish() waits at most
};

// Thread-safe. No call but Finish() waits for the viewer.
class DisplayServer {
 public:
  explicit DisplayServer(DisplayOptions options);
  // Drops what was not sent; returns within moments, whatever the viewer or a name server does.
  ~DisplayServer();
  DisplayServer(const DisplayServer&) = delete;
  DisplayServer& operator=(const DisplayServer&) = delete;

  // A tile of info.tiles; `film` holds at least its pixels. Channels are all that `film` has, under
  // their names in the EXR file; places are relative to the crop. A tile that was sent is not sent
  // again, however often it is shown.
  void ShowTile(const JobInfo& info, uint32_t tile, const Film& film);

  // A frame's film of the whole crop: what the viewer lacks of it is sent when the queue is empty.
  // The next frame replaces one that waits.
  void ShowFrame(const JobInfo& info, uint32_t frame, Film film);

  // Waits until all is sent; not if there is no viewer, and at most for finish_time.
  void Finish();

 private:
  struct State;
  const std::shared_ptr<State> state_;
};

}  // namespace farpoint
