// Material libraries of OBJ files (MTL): what of them a Lambert renderer shows.
#pragma once

#include <map>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/blob.h"
#include "core/base/status.h"
#include "core/math/vec.h"
#include "core/scene/asset_source.h"

namespace farpoint {

// A map_* statement.
struct MtlMap {
  std::string path;  // as written, with '/' for '\'
  size_t line = 0;
  Vec2f scale{1, 1}, offset{0, 0};  // -s, -o: uv' = scale * uv + offset, from the lower left corner
  bool clamp = false;               // -clamp on
  bool present() const { return !path.empty(); }
};

struct MtlMaterial {
  std::string name;
  size_t line = 0;
  std::optional<Rgb> diffuse;                     // Kd
  std::optional<Rgb> emission;                    // Ke
  std::optional<double> opacity;                  // d, or 1 - Tr
  double metallic = 0, roughness = 1;             // Pm, Pr
  MtlMap diffuse_map, emission_map, opacity_map;  // map_Kd, map_Ke, map_d
};

struct MtlFile {
  std::vector<MtlMaterial> materials;  // as in the file
  std::vector<std::string> notes;
};

// `name` stands in the messages, which name the line. kInvalidArgument for numbers that are none.
absl::StatusOr<MtlFile> ParseMtl(const std::string& name, std::string_view text);

// A texture that a material needs: the URI of its file and what the map_* statement says of it.
struct MtlTexture {
  std::string uri;
  MtlMap map;
};

// The materials that an OBJ file uses, with the files of their textures. Each mtllib statement and
// each map_* statement must lead to a file of `source`: kNotFound names file, line and what is
// missing.
class ObjMaterials {
 public:
  struct Entry {
    MtlMaterial material;
    std::optional<MtlTexture> diffuse, emission, opacity;
  };

  // `libraries`: the rest of each mtllib statement of the OBJ file and its line; `used`: the names
  // of its usemtl statements. Only materials that are used are kept, and the first of each name.
  static absl::StatusOr<ObjMaterials> Load(
      const std::string& root, const std::vector<std::pair<std::string, size_t>>& libraries,
      const std::set<std::string>& used, AssetSource& source);

  const std::map<std::string, Entry>& by_name() const { return by_name_; }
  const std::vector<std::string>& notes() const { return notes_; }

 private:
  std::map<std::string, Entry> by_name_;
  std::vector<std::string> notes_;
};

}  // namespace farpoint
