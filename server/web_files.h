// The files of server/web, as they are built into the program.
#pragma once

#include <string_view>

namespace farpoint {

struct WebFile {
  std::string_view path, type, contents;  // "/app.js", "text/javascript; charset=utf-8", …
};
extern const WebFile kWebFiles[3];

}  // namespace farpoint
