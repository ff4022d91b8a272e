// Where an importer gets the files from that the main file refers to.
#pragma once

#include <string>

#include "core/base/blob.h"
#include "core/base/status.h"

namespace farpoint {

class AssetSource {
 public:
  virtual ~AssetSource() = default;
  // `uri` is relative to the main file's folder, with '/' between its parts.
  virtual bool Has(const std::string& uri) = 0;
  // kNotFound and others name the file.
  virtual absl::StatusOr<Blob> Read(const std::string& uri) = 0;
};

}  // namespace farpoint
