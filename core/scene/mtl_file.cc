#include "core/scene/mtl_file.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "core/scene/text_lines.h"

namespace farpoint {

namespace {

constexpr size_t kMaxMaterials = size_t{1} << 18;

// '\' is a separator but before a blank, which it makes part of a name.
std::string ToPath(std::string_view text) {
  std::string path;
  for (size_t i = 0; i < text.size(); ++i) {
    if (text[i] != '\\') {
      path += text[i];
    } else if (i + 1 < text.size() && text[i + 1] == ' ') {
      path += ' ';
      ++i;
    } else if (path.empty() || path.back() != '/') {
      path += '/';
    }
  }
  return path;
}

// Words between blanks that no backslash precedes.
std::vector<std::string> SplitPaths(std::string_view text) {
  std::vector<std::string> paths;
  size_t begin = 0;
  for (size_t i = 0; i <= text.size(); ++i) {
    const bool end = i == text.size() ||
                     ((text[i] == ' ' || text[i] == '\t') && !(i > 0 && text[i - 1] == '\\'));
    if (!end) continue;
    if (i > begin) paths.push_back(ToPath(text.substr(begin, i - begin)));
    begin = i + 1;
  }
  return paths;
}

// "a/./b/../c" as "a/c". Nothing if the path is absolute or leaves its folder.
std::optional<std::string> Normalized(const std::string& folder, const std::string& path) {
  const bool drive = path.size() > 1 && path[1] == ':';
  if (path.empty() || path[0] == '/' || drive || path.find('\0') != std::string::npos) {
    return std::nullopt;
  }
  const std::string whole = folder + path;
  std::vector<std::string_view> parts;
  size_t begin = 0;
  while (begin <= whole.size()) {
    const size_t end = std::min(whole.find('/', begin), whole.size());
    const std::string_view part = std::string_view(whole).substr(begin, end - begin);
    if (part == "..") {
      if (parts.empty()) return std::nullopt;
      parts.pop_back();
    } else if (!part.empty() && part != ".") {
      parts.push_back(part);
    }
    begin = end + 1;
  }
  if (parts.empty()) return std::nullopt;
  std::string joined;
  for (const std::string_view part : parts) {
    if (!joined.empty()) joined += '/';
    joined += part;
  }
  return joined;
}

std::string FolderOf(const std::string& uri) {
  const size_t slash = uri.rfind('/');
  return slash == std::string::npos ? "" : uri.substr(0, slash + 1);
}

// The file that `path`, written in a file in `folder`, means: in that folder, in the main file's,
// or, for paths of somebody's disk, the same name in one of the two.
std::optional<std::string> Locate(const std::string& folder, const std::string& path,
                                  AssetSource& source) {
  const size_t slash = path.rfind('/');
  const std::string base = slash == std::string::npos ? path : path.substr(slash + 1);
  for (const std::string& name : {path, base}) {
    for (const std::string& in : {folder, std::string()}) {
      const auto uri = Normalized(in, name);
      if (uri && source.Has(*uri)) return uri;
    }
  }
  return std::nullopt;
}

absl::Status Missing(const std::string& place, const std::string& path) {
  return absl::NotFoundError(place + ": '" + Printable(path) +
                             "' is missing; put the file beside the scene or correct the path");
}

class Parser {
 public:
  Parser(std::string name, std::string_view text) : name_(std::move(name)), lines_(text) {}

  absl::StatusOr<MtlFile> Run() {
    std::string_view line;
    while (lines_.Next(line)) {
      std::string_view rest = line;
      const std::string_view key = NextWord(rest);
      if (key.empty() || key[0] == '#') continue;
      FP_RETURN_IF_ERROR(Statement(key, Trim(rest)));
    }
    if (ignored_options_ > 0) {
      file_.notes.push_back(name_ + ": -mm, -t and other options of " +
                            std::to_string(ignored_options_) + " texture maps are ignored");
    }
    return std::move(file_);
  }

 private:
  absl::Status Fail(const std::string& text) const {
    return absl::InvalidArgumentError(name_ + ": line " + std::to_string(lines_.number()) + ": " +
                                      text);
  }
  void Note(const std::string& text) {
    file_.notes.push_back(name_ + ": line " + std::to_string(lines_.number()) + ": " + text);
  }

  absl::Status Statement(std::string_view key, std::string_view rest) {
    if (key == "newmtl") {
      if (file_.materials.size() >= kMaxMaterials) {
        return Fail("more than " + std::to_string(kMaxMaterials) + " materials; remove some");
      }
      file_.materials.emplace_back();
      file_.materials.back().name = std::string(rest);
      file_.materials.back().line = lines_.number();
      return absl::OkStatus();
    }
    const bool is_read = key == "Kd" || key == "Ke" || key == "d" || key == "Tr" || key == "Pm" ||
                         key == "Pr" || key == "map_Kd" || key == "map_Ke" || key == "map_d" ||
                         key == "map_emissive";
    if (!is_read) return absl::OkStatus();
    if (file_.materials.empty()) {
      Note("'" + std::string(key) + "' before the first newmtl is ignored");
      return absl::OkStatus();
    }
    MtlMaterial& m = file_.materials.back();
    if (key == "Kd") return ReadColor("Kd", rest, 1.0, m.diffuse);
    if (key == "Ke") return ReadColor("Ke", rest, 1e12, m.emission);
    if (key == "d" || key == "Tr") {
      std::string_view words = rest;
      if (key == "d" && rest.substr(0, 5) == "-halo") NextWord(words);
      double value = 0;
      FP_RETURN_IF_ERROR(ReadUnit(key, words, value));
      if (key == "d") {
        m.opacity = value;
        has_d_ = file_.materials.size();
      } else if (has_d_ != file_.materials.size()) {  // of the two, d wins
        m.opacity = 1 - value;
      }
      return absl::OkStatus();
    }
    if (key == "Pm") return ReadUnit(key, rest, m.metallic);
    if (key == "Pr") return ReadUnit(key, rest, m.roughness);
    if (key == "map_Kd") return ReadMap(rest, m.diffuse_map);
    if (key == "map_d") return ReadMap(rest, m.opacity_map);
    return ReadMap(rest, m.emission_map);
  }

  absl::Status ReadUnit(std::string_view key, std::string_view rest, double& out) {
    const std::string_view word = NextWord(rest);
    const auto value = ParseNumber(word);
    if (!value || !(*value >= 0 && *value <= 1)) {
      return Fail(std::string(key) + " is " + Quoted(word) + " instead of a number in [0, 1]");
    }
    out = *value;
    return absl::OkStatus();
  }

  // One number stands for all three.
  absl::Status ReadColor(const char* key, std::string_view rest, double max,
                         std::optional<Rgb>& out) {
    std::array<double, 3> c{};
    int count = 0;
    bool clamped = false;
    while (count < 3) {
      const std::string_view word = NextWord(rest);
      if (word.empty() || word[0] == '#') break;
      if (count == 0 && (word == "spectral" || word == "xyz")) {
        Note(std::string(key) + " " + std::string(word) + " is ignored; give it as r g b");
        return absl::OkStatus();
      }
      const auto value = ParseNumber(word);
      if (!value || !(*value >= 0 && *value <= 1e12)) {
        return Fail(std::string(key) + " holds " + Quoted(word) +
                    " instead of a number in [0, 1e12]");
      }
      clamped |= *value > max;
      c[static_cast<size_t>(count++)] = std::min(*value, max);
    }
    if (count == 0) return Fail(std::string(key) + " has no numbers; expected r g b");
    if (count == 2) return Fail(std::string(key) + " has two numbers; expected r g b");
    if (count == 1) c[1] = c[2] = c[0];
    if (clamped) Note(std::string(key) + " above 1 would create light; taken as 1");
    out = Rgb(static_cast<float>(c[0]), static_cast<float>(c[1]), static_cast<float>(c[2]));
    return absl::OkStatus();
  }

  // Options, then a path that may hold blanks.
  absl::Status ReadMap(std::string_view rest, MtlMap& out) {
    MtlMap map;
    map.line = lines_.number();
    while (!rest.empty() && rest[0] == '-') {
      std::string_view after = rest;
      const std::string_view option = NextWord(after);
      if (option == "-s" || option == "-o" || option == "-t") {
        // One to three numbers.
        std::array<double, 3> v = {0, 0, 0};
        int count = 0;
        while (count < 3) {
          std::string_view next = after;
          const auto value = ParseNumber(NextWord(next));
          if (!value) break;
          if (!(std::fabs(*value) <= 1e9)) {
            return Fail(std::string(option) + " is beyond [-1e9, 1e9]");
          }
          v[static_cast<size_t>(count++)] = *value;
          after = next;
        }
        if (count == 0) return Fail(std::string(option) + " has no numbers");
        const auto u0 = static_cast<float>(v[0]);
        const auto v0 = static_cast<float>(v[1]);
        if (option == "-s") map.scale = {u0, count > 1 ? v0 : 1.0f};
        if (option == "-o") map.offset = {u0, count > 1 ? v0 : 0.0f};
        if (option == "-t") ++ignored_options_;
      } else if (option == "-clamp") {
        map.clamp = NextWord(after) == "on";
      } else if (option == "-mm") {
        NextWord(after);
        NextWord(after);
        ++ignored_options_;
      } else if (option == "-blendu" || option == "-blendv" || option == "-cc" ||
                 option == "-boost" || option == "-bm" || option == "-texres" ||
                 option == "-imfchan" || option == "-type" || option == "-colorspace") {
        NextWord(after);
      } else {
        break;  // a file whose name starts with a dash
      }
      rest = Trim(after);
    }
    map.path = ToPath(rest);
    if (map.path.empty()) return Fail("a texture map names no file");
    out = std::move(map);
    return absl::OkStatus();
  }

  const std::string name_;
  LineReader lines_;
  MtlFile file_;
  size_t has_d_ = 0;  // number of the material that has a `d`
  size_t ignored_options_ = 0;
};

}  // namespace

absl::StatusOr<MtlFile> ParseMtl(const std::string& name, std::string_view text) {
  if (text.substr(0, 3) == "\xef\xbb\xbf") text.remove_prefix(3);
  return Parser(Printable(name), text).Run();
}

absl::StatusOr<ObjMaterials> ObjMaterials::Load(
    const std::string& root, const std::vector<std::pair<std::string, size_t>>& libraries,
    const std::set<std::string>& used, AssetSource& source) {
  ObjMaterials materials;
  std::set<std::string> loaded;
  for (const auto& [statement, line] : libraries) {
    const std::string place = root + ": line " + std::to_string(line) + ": mtllib";
    std::vector<std::string> uris;
    // A name with blanks, or several names.
    if (const auto whole = Locate("", ToPath(statement), source)) {
      uris.push_back(*whole);
    } else {
      for (const std::string& path : SplitPaths(statement)) {
        const auto uri = Locate("", path, source);
        if (!uri) return Missing(place, path);
        uris.push_back(*uri);
      }
    }
    for (const std::string& uri : uris) {
      if (!loaded.insert(uri).second) continue;
      FP_ASSIGN_OR_RETURN(const Blob blob, source.Read(uri));
      const std::string_view text(reinterpret_cast<const char*>(blob.bytes().data()), blob.size());
      FP_ASSIGN_OR_RETURN(MtlFile file, ParseMtl(uri, text));
      materials.notes_.insert(materials.notes_.end(), file.notes.begin(), file.notes.end());
      for (MtlMaterial& material : file.materials) {
        if (used.count(material.name) == 0 || materials.by_name_.count(material.name) != 0) {
          continue;
        }
        Entry entry;
        const auto find = [&](const MtlMap& map, std::optional<MtlTexture>& out) -> absl::Status {
          if (!map.present()) return absl::OkStatus();
          const auto found = Locate(FolderOf(uri), map.path, source);
          if (!found) {
            return Missing(root + ": " + Printable(uri) + ": line " + std::to_string(map.line),
                           map.path);
          }
          FP_RETURN_IF_ERROR(source.Read(*found).status());
          out = MtlTexture{*found, map};
          return absl::OkStatus();
        };
        FP_RETURN_IF_ERROR(find(material.diffuse_map, entry.diffuse));
        FP_RETURN_IF_ERROR(find(material.emission_map, entry.emission));
        FP_RETURN_IF_ERROR(find(material.opacity_map, entry.opacity));
        std::string name = material.name;
        entry.material = std::move(material);
        materials.by_name_.emplace(std::move(name), std::move(entry));
      }
    }
  }
  return materials;
}

}  // namespace farpoint
