#include "core/scene/obj_importer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

#include "core/scene/image_decode.h"
#include "core/scene/mtl_file.h"
#include "core/scene/polygon.h"
#include "core/scene/text_lines.h"

namespace farpoint {

namespace {

// Beyond this many, parts are told apart by their material only.
constexpr size_t kMaxParts = size_t{1} << 16;
constexpr size_t kMaxMaterialNames = size_t{1} << 18;
constexpr uint64_t kMaxMergedTexels = uint64_t{1} << 26;
constexpr uint32_t kNone = MeshCorner::kNone;
constexpr const char* kCorrect = "; correct the file or export it again";

std::string_view TextOf(const Blob& file) {
  std::string_view text(reinterpret_cast<const char*>(file.bytes().data()), file.size());
  if (text.substr(0, 3) == "\xef\xbb\xbf") text.remove_prefix(3);
  return text;
}

std::string Counted(uint64_t count, const char* what) {
  return std::to_string(count) + " " + what + (count == 1 ? "" : "s");
}

// Statements of the format that draw nothing that is shown here.
bool IsKnownButIgnored(std::string_view key) {
  static const std::set<std::string_view> kKnown = {
      "vp",       "vw",         "cstype",    "deg",  "bmat",  "step",  "curv",
      "curv2",    "surf",       "parm",      "trim", "hole",  "scrv",  "sp",
      "end",      "con",        "mg",        "lod",  "bevel", "call",  "c_interp",
      "d_interp", "shadow_obj", "trace_obj", "csh",  "t",     "ctech", "stech"};
  return kKnown.count(key) != 0;
}

using Libraries = std::vector<std::pair<std::string, size_t>>;

// The files of an asset that is in memory.
class BundleSource : public AssetSource {
 public:
  explicit BundleSource(const AssetBundle& asset) : asset_(asset) {}
  bool Has(const std::string& uri) override { return asset_.files.count(uri) != 0; }
  absl::StatusOr<Blob> Read(const std::string& uri) override { return asset_.Find(uri); }

 private:
  const AssetBundle& asset_;
};

struct Face {
  uint32_t first_corner, corner_count;
  uint64_t line;
};

// Faces that become one mesh.
struct Part {
  std::string object, group;
  uint32_t material = 0;  // index into material_names_; 0: none
  bool has_uv = false, has_normals = false;
  std::vector<Face> faces;
};

class ObjReader {
 public:
  ObjReader(const AssetBundle& asset, const ImportOptions& options)
      : asset_(asset), options_(options) {}

  absl::StatusOr<ImportedScene> Run() {
    FP_ASSIGN_OR_RETURN(const Blob file, asset_.Find(asset_.root));
    const std::string_view text = TextOf(file);
    if (text.size() >= 2 && (text.substr(0, 2) == "\xff\xfe" || text.substr(0, 2) == "\xfe\xff")) {
      return absl::InvalidArgumentError(asset_.root +
                                        ": byte 0: is UTF-16; save the file as UTF-8 or ASCII");
    }
    FP_RETURN_IF_ERROR(ReadStatements(text));
    if (known_statements_ == 0) {
      return absl::InvalidArgumentError(
          asset_.root +
          ": line 1: holds no statement of an OBJ file; is it a file of another kind?");
    }
    imported_.scene.name = asset_.root;
    FP_RETURN_IF_ERROR(CheckCorners());
    FP_RETURN_IF_ERROR(BuildMaterials());
    for (Part& part : parts_) FP_RETURN_IF_ERROR(BuildMesh(part));
    AddNotes();
    return std::move(imported_);
  }

 private:
  absl::Status Fail(uint64_t line, const std::string& text) const {
    return absl::InvalidArgumentError(asset_.root + ": line " + std::to_string(line) + ": " + text +
                                      kCorrect);
  }
  void Note(std::string text) { imported_.notes.push_back(std::move(text)); }

  absl::Status ReadStatements(std::string_view text) {
    LineReader lines(text);
    std::string_view line;
    material_names_.push_back("");
    while (lines.Next(line)) {
      std::string_view rest = line;
      const std::string_view key = NextWord(rest);
      if (key.empty() || key[0] == '#') continue;
      line_ = lines.number();
      FP_RETURN_IF_ERROR(Statement(key, rest));
    }
    return absl::OkStatus();
  }

  absl::Status Statement(std::string_view key, std::string_view rest) {
    ++known_statements_;
    if (key == "v") return ReadPosition(rest);
    if (key == "vt") return ReadUv(rest);
    if (key == "vn") return ReadNormal(rest);
    if (key == "f" || key == "fo") return ReadFace(rest);
    if (key == "o" || key == "g") {
      (key == "o" ? object_ : group_) = Printable(Trim(rest));
      if (key == "o") group_.clear();
      current_part_.fill(kNone);
      return absl::OkStatus();
    }
    if (key == "usemtl") return UseMaterial(std::string(Trim(rest)));
    if (key == "mtllib") {
      libraries_.emplace_back(std::string(Trim(rest)), line_);
      return absl::OkStatus();
    }
    if (key == "s") {
      const std::string_view value = NextWord(rest);
      has_smoothing_ |= value != "off" && value != "0";
      return absl::OkStatus();
    }
    if (key == "l" || key == "p") {
      ++skipped_lines_;
      return absl::OkStatus();
    }
    if (IsKnownButIgnored(key)) {
      ignored_.insert(std::string(key));
      return absl::OkStatus();
    }
    --known_statements_;
    if (unknown_++ == 0) first_unknown_ = Quoted(key) + " in line " + std::to_string(line_);
    return absl::OkStatus();
  }

  // Up to `max` numbers, at least `min`.
  absl::Status ReadNumbers(std::string_view rest, size_t min, size_t max, const char* what,
                           std::array<double, 7>& out, size_t& count) const {
    count = 0;
    while (count < max) {
      const std::string_view word = NextWord(rest);
      if (word.empty() || word[0] == '#') break;
      const auto value = ParseNumber(word);
      if (!value) return Fail(line_, Quoted(word) + " of the " + what + " is no number");
      if (!std::isfinite(*value)) {
        return Fail(line_, Quoted(word) + " of the " + what + " is not finite");
      }
      out[count++] = *value;
    }
    if (count < min) {
      return Fail(line_, "the " + std::string(what) + " has " + std::to_string(count) +
                             " numbers instead of " + std::to_string(min));
    }
    return absl::OkStatus();
  }

  absl::Status CheckCount(size_t count, const char* what) const {
    if (count < kNone) return absl::OkStatus();
    return Fail(line_, "more than 2^32 " + std::string(what));
  }

  // x y z [w], or x y z r g b.
  absl::Status ReadPosition(std::string_view rest) {
    std::array<double, 7> v{};
    size_t count = 0;
    FP_RETURN_IF_ERROR(ReadNumbers(rest, 3, 7, "position", v, count));
    const Vec3d p(v[0], v[1], v[2]);
    if (!IsFinite(p) || MaxAbs(p) > std::numeric_limits<float>::max()) {
      return Fail(line_, "the position is beyond the range of single precision (3.4e38)");
    }
    FP_RETURN_IF_ERROR(CheckCount(positions_.size(), "positions"));
    positions_.push_back(p);
    if (count >= 6) {
      colors_.resize(positions_.size() - 1, Rgb(1));
      const auto color = [&](size_t i) { return static_cast<float>(std::clamp(v[i], 0.0, 1.0)); };
      colors_.push_back({color(3), color(4), color(5)});
    } else if (!colors_.empty()) {
      colors_.push_back(Rgb(1));
    }
    return absl::OkStatus();
  }

  absl::Status ReadUv(std::string_view rest) {
    std::array<double, 7> v{};
    size_t count = 0;
    FP_RETURN_IF_ERROR(ReadNumbers(rest, 1, 3, "texture coordinate", v, count));
    FP_RETURN_IF_ERROR(CheckCount(uvs_.size(), "texture coordinates"));
    // OBJ counts v from the lower edge of the image, Scene from the upper one.
    const Vec2f uv{static_cast<float>(v[0]), static_cast<float>(1 - v[1])};
    if (!std::isfinite(uv.x) || !std::isfinite(uv.y)) {
      return Fail(line_, "the texture coordinate is beyond the range of single precision");
    }
    uvs_.push_back(uv);
    return absl::OkStatus();
  }

  absl::Status ReadNormal(std::string_view rest) {
    std::array<double, 7> v{};
    size_t count = 0;
    FP_RETURN_IF_ERROR(ReadNumbers(rest, 3, 3, "normal", v, count));
    FP_RETURN_IF_ERROR(CheckCount(normals_.size(), "normals"));
    normals_.push_back(Vec3f(NormalizeOr(Vec3d(v[0], v[1], v[2]), Vec3d())));
    return absl::OkStatus();
  }

  // The index, from 0, of a reference as it is written: from 1, or from -1 backwards.
  absl::Status ReadIndex(std::string_view text, size_t count, const char* what, uint32_t& out) {
    const auto value = ParseInteger(text);
    if (!value) {
      return Fail(line_, Quoted(text) + " is no index of a " + std::string(what));
    }
    if (*value == 0) {
      return Fail(line_, "index 0 of a " + std::string(what) + "; OBJ counts from 1");
    }
    if (*value < 0) {
      if (*value < -static_cast<int64_t>(count)) {
        return Fail(line_, "index " + std::to_string(*value) + " of a " + what +
                               " is before the first of the " + std::to_string(count) +
                               " that stand above it");
      }
      out = static_cast<uint32_t>(static_cast<int64_t>(count) + *value);
      return absl::OkStatus();
    }
    if (*value >= static_cast<int64_t>(kNone)) {
      return Fail(line_, "index " + std::to_string(*value) + " of a " + what + " is beyond 2^32");
    }
    out = static_cast<uint32_t>(*value - 1);
    return absl::OkStatus();
  }

  absl::Status ReadFace(std::string_view rest) {
    const size_t first = corners_.size();
    bool has_uv = true, has_normals = true;
    for (;;) {
      std::string_view word = NextWord(rest);
      if (word.empty() || word[0] == '#') break;
      MeshCorner corner;
      const size_t slash = word.find('/');
      FP_RETURN_IF_ERROR(
          ReadIndex(word.substr(0, slash), positions_.size(), "position", corner.position));
      if (slash != std::string_view::npos) {
        word.remove_prefix(slash + 1);
        const size_t second = word.find('/');
        const std::string_view uv = word.substr(0, second);
        if (!uv.empty()) {
          FP_RETURN_IF_ERROR(ReadIndex(uv, uvs_.size(), "texture coordinate", corner.uv));
        }
        if (second != std::string_view::npos) {
          const std::string_view normal = word.substr(second + 1);
          if (!normal.empty()) {
            FP_RETURN_IF_ERROR(ReadIndex(normal, normals_.size(), "normal", corner.normal));
          }
        }
      }
      has_uv &= corner.uv != kNone;
      has_normals &= corner.normal != kNone;
      corners_.push_back(corner);
    }
    const size_t count = corners_.size() - first;
    if (count < 3) {
      ++skipped_faces_;
      corners_.resize(first);
      return absl::OkStatus();
    }
    if (count > kMaxPolygonCorners) {
      return Fail(line_, "the face has " + std::to_string(count) + " corners, more than " +
                             std::to_string(kMaxPolygonCorners) + "; triangulate it");
    }
    FP_RETURN_IF_ERROR(CheckCount(corners_.size(), "corners of faces"));
    triangle_count_ += count - 2;
    if (triangle_count_ > options_.max_triangles) {
      return absl::ResourceExhaustedError(
          asset_.root + ": line " + std::to_string(line_) + ": the scene has more than " +
          std::to_string(options_.max_triangles) + " triangles; simplify it or raise the limit");
    }
    PartFor(has_uv, has_normals)
        .faces.push_back({static_cast<uint32_t>(first), static_cast<uint32_t>(count), line_});
    return absl::OkStatus();
  }

  Part& PartFor(bool has_uv, bool has_normals) {
    uint32_t& current = current_part_[(has_uv ? 1 : 0) + (has_normals ? 2 : 0)];
    if (current == kNone) {
      const bool few = parts_.size() < kMaxParts;
      const auto key = std::make_tuple(few ? object_ : std::string(), few ? group_ : std::string(),
                                       material_, has_uv, has_normals);
      const auto [it, is_new] = part_index_.try_emplace(key, static_cast<uint32_t>(parts_.size()));
      if (is_new) {
        parts_.push_back({std::get<0>(key), std::get<1>(key), material_, has_uv, has_normals, {}});
      }
      current = it->second;
    }
    return parts_[current];
  }

  absl::Status UseMaterial(std::string name) {
    current_part_.fill(kNone);
    if (name.empty()) {
      material_ = 0;
      return absl::OkStatus();
    }
    const auto [it, is_new] =
        material_index_.try_emplace(name, static_cast<uint32_t>(material_names_.size()));
    if (is_new) {
      if (material_names_.size() >= kMaxMaterialNames) {
        return Fail(line_, "more than " + std::to_string(kMaxMaterialNames) + " materials");
      }
      material_names_.push_back(std::move(name));
      material_lines_.emplace(it->second, line_);
    }
    material_ = it->second;
    return absl::OkStatus();
  }

  // References forward are fine, so they are checked when all is read.
  absl::Status CheckCorners() const {
    const auto fail = [&](const Face& face, const char* what, uint32_t index, size_t count) {
      return Fail(face.line, "index " + std::to_string(uint64_t{index} + 1) + " of a " + what +
                                 " is beyond the " + std::to_string(count) + " of the file");
    };
    for (const Part& part : parts_) {
      for (const Face& face : part.faces) {
        for (uint32_t i = 0; i < face.corner_count; ++i) {
          const MeshCorner& c = corners_[face.first_corner + i];
          if (c.position >= positions_.size()) {
            return fail(face, "position", c.position, positions_.size());
          }
          if (c.uv != kNone && c.uv >= uvs_.size()) {
            return fail(face, "texture coordinate", c.uv, uvs_.size());
          }
          if (c.normal != kNone && c.normal >= normals_.size()) {
            return fail(face, "normal", c.normal, normals_.size());
          }
        }
      }
    }
    return absl::OkStatus();
  }

  absl::Status BuildMaterials() {
    scene_material_.assign(material_names_.size(), -1);
    const std::set<std::string> used(material_names_.begin() + 1, material_names_.end());
    BundleSource source(asset_);
    FP_ASSIGN_OR_RETURN(const ObjMaterials materials,
                        ObjMaterials::Load(asset_.root, libraries_, used, source));
    for (const std::string& note : materials.notes()) Note(note);
    size_t undefined = 0;
    std::string first_undefined;
    for (size_t i = 1; i < material_names_.size(); ++i) {
      const auto it = materials.by_name().find(material_names_[i]);
      if (it == materials.by_name().end()) {
        if (undefined++ == 0) {
          first_undefined = Quoted(material_names_[i]) + " in line " +
                            std::to_string(material_lines_.at(static_cast<uint32_t>(i)));
        }
        continue;
      }
      FP_RETURN_IF_ERROR(AddMaterial(it->second, i));
    }
    if (undefined > 0) {
      Note(Counted(undefined, "material") + " (" + first_undefined + (undefined > 1 ? ", …" : "") +
           ") not defined by any material library: shown white");
    }
    if (cut_out_ > 0) {
      Note(Counted(cut_out_, "material") +
           " of d, Tr or map_d: cut out where the opacity is below 0.5 instead of blended");
    }
    return absl::OkStatus();
  }

  absl::Status AddMaterial(const ObjMaterials::Entry& entry, size_t name_index) {
    const MtlMaterial& m = entry.material;
    Material material;
    material.name = Printable(m.name);
    material.metallic = static_cast<float>(m.metallic);
    material.roughness = static_cast<float>(m.roughness);
    material.base_color = m.diffuse.value_or(Rgb(1));
    if (entry.diffuse && material.base_color == Rgb()) {
      Note("material '" + material.name + "': Kd 0 would hide its map_Kd; taken as 1");
      material.base_color = Rgb(1);
    }
    material.emission = m.emission.value_or(entry.emission ? Rgb(1) : Rgb());
    if (entry.emission && material.emission == Rgb()) {
      Note("material '" + material.name + "': Ke 0 would hide its map_Ke; taken as 1");
      material.emission = Rgb(1);
    }
    if (entry.emission) {
      FP_ASSIGN_OR_RETURN(material.emission_texture, AddTexture(*entry.emission));
    }
    // A constant opacity of 0.5 and more cuts nothing out; an alpha channel of map_Kd counts only
    // where map_d asks for it.
    if (m.opacity.value_or(1) < 1 || entry.opacity) ++cut_out_;
    if (entry.opacity || m.opacity.value_or(1) < 0.5) {
      material.alpha_mode = AlphaMode::kMask;
      material.alpha_cutoff = 0.5f;
      material.base_alpha = static_cast<float>(m.opacity.value_or(1));
    }
    if (entry.opacity) {
      FP_ASSIGN_OR_RETURN(material.base_color_texture, AddCutOut(entry));
    } else if (entry.diffuse) {
      FP_ASSIGN_OR_RETURN(material.base_color_texture, AddTexture(*entry.diffuse));
    }
    scene_material_[name_index] = static_cast<int32_t>(imported_.scene.materials.size());
    imported_.scene.materials.push_back(std::move(material));
    return absl::OkStatus();
  }

  // -s and -o count v from the lower edge: v' = s v + o there is 1 - s - o + s v from the upper.
  static UvTransform TransformOf(const MtlMap& map) {
    UvTransform transform;
    transform.scale = map.scale;
    transform.offset = {map.offset.x, 1 - map.scale.y - map.offset.y};
    return transform;
  }

  absl::StatusOr<TextureRef> AddTexture(const MtlTexture& source) {
    const auto [it, is_new] = texture_index_.try_emplace(
        {source.uri, "", source.map.clamp}, static_cast<int32_t>(imported_.scene.textures.size()));
    if (is_new) {
      FP_ASSIGN_OR_RETURN(Blob blob, asset_.Find(source.uri));
      PushTexture(source.uri, std::move(blob), source.map.clamp);
    }
    return TextureRef{it->second, 0, TransformOf(source.map)};
  }

  void PushTexture(const std::string& name, Blob encoded, bool clamp) {
    Texture texture;
    texture.name = Printable(name);
    texture.encoded = std::move(encoded);
    texture.wrap_s = texture.wrap_t = clamp ? WrapMode::kClampToEdge : WrapMode::kRepeat;
    imported_.scene.textures.push_back(std::move(texture));
  }

  // Colour of map_Kd, if there is one, with the opacity of map_d as its alpha.
  absl::StatusOr<TextureRef> AddCutOut(const ObjMaterials::Entry& entry) {
    const MtlTexture& opacity = *entry.opacity;
    const MtlTexture& main = entry.diffuse ? *entry.diffuse : opacity;
    const auto [it, is_new] =
        texture_index_.try_emplace({entry.diffuse ? main.uri : "", opacity.uri, main.map.clamp},
                                   static_cast<int32_t>(imported_.scene.textures.size()));
    if (is_new) {
      std::optional<DecodedImage> color;
      FP_ASSIGN_OR_RETURN(const Blob opacity_file, asset_.Find(opacity.uri));
      FP_ASSIGN_OR_RETURN(DecodedImage mask,
                          DecodeImage(Printable(opacity.uri), opacity_file.bytes()));
      if (entry.diffuse && main.uri != opacity.uri) {
        FP_ASSIGN_OR_RETURN(const Blob file, asset_.Find(main.uri));
        FP_ASSIGN_OR_RETURN(color, DecodeImage(Printable(main.uri), file.bytes()));
      }
      FP_ASSIGN_OR_RETURN(Blob merged,
                          MergeOpacity(color ? &*color : nullptr, mask, entry.diffuse.has_value(),
                                       Printable(opacity.uri)));
      PushTexture(opacity.uri, std::move(merged), main.map.clamp);
      const MtlMap &a = main.map, &b = opacity.map;
      if (!(a.scale == b.scale) || !(a.offset == b.offset) || a.clamp != b.clamp) {
        Note("material '" + Printable(entry.material.name) +
             "': map_d has other -s, -o or -clamp than map_Kd, whose are used");
      }
    }
    return TextureRef{it->second, 0, TransformOf(main.map)};
  }

  // `mask`'s alpha channel if it holds one, else its brightness.
  static absl::StatusOr<Blob> MergeOpacity(const DecodedImage* color, const DecodedImage& mask,
                                           bool keep_mask_color, const std::string& name) {
    const bool has_alpha = std::any_of(mask.texels.begin(), mask.texels.end(),
                                       [](uint32_t t) { return t >> 24 != 255; });
    DecodedImage merged;
    merged.width = std::max(color != nullptr ? color->width : 0, mask.width);
    merged.height = std::max(color != nullptr ? color->height : 0, mask.height);
    if (uint64_t{merged.width} * merged.height > kMaxMergedTexels) {
      return absl::InvalidArgumentError(
          "image '" + name + "': is too large to be joined to map_Kd (" +
          std::to_string(merged.width) + " x " + std::to_string(merged.height) +
          " texels, more than 2^26); make it smaller");
    }
    merged.texels.resize(size_t{merged.width} * merged.height);
    const auto at = [&](const DecodedImage& image, uint32_t x, uint32_t y) {
      const uint64_t ix = uint64_t{x} * image.width / merged.width;
      const uint64_t iy = uint64_t{y} * image.height / merged.height;
      return image.texels[iy * image.width + ix];
    };
    for (uint32_t y = 0; y < merged.height; ++y) {
      for (uint32_t x = 0; x < merged.width; ++x) {
        const uint32_t m = at(mask, x, y);
        // Channels' weights as in Rec. 709, in 1/256.
        const uint32_t grey =
            ((m & 255) * 54 + (m >> 8 & 255) * 183 + (m >> 16 & 255) * 19 + 128) >> 8;
        const uint32_t alpha = has_alpha ? m >> 24 : grey;
        const uint32_t rgb = color != nullptr ? at(*color, x, y) : keep_mask_color ? m : 0xffffff;
        merged.texels[size_t{y} * merged.width + x] = (rgb & 0xffffff) | alpha << 24;
      }
    }
    return EncodePng(merged);
  }

  absl::Status BuildMesh(Part& part) {
    Mesh mesh;
    mesh.name = part.object.empty()  ? part.group
                : part.group.empty() ? part.object
                                     : part.object + "/" + part.group;
    if (mesh.name.empty()) mesh.name = asset_.root;
    mesh.material = scene_material_[part.material];
    size_t corner_count = 0;
    for (const Face& face : part.faces) corner_count += face.corner_count;
    CornerIndex index(corner_count);
    std::vector<Vec3d> polygon;
    std::vector<std::array<uint32_t, 3>> cut;
    for (const Face& face : part.faces) {
      const MeshCorner* corners = &corners_[face.first_corner];
      polygon.clear();
      cut.clear();
      for (uint32_t i = 0; i < face.corner_count; ++i) {
        polygon.push_back(positions_[corners[i].position]);
      }
      if (!TriangulatePolygon(polygon, cut)) ++crossed_faces_;
      for (const auto& triangle : cut) {
        std::array<uint32_t, 3> vertices{};
        for (size_t k = 0; k < 3; ++k) {
          MeshCorner corner = corners[triangle[k]];
          if (!part.has_uv) corner.uv = kNone;
          if (!part.has_normals) corner.normal = kNone;
          vertices[k] = index.VertexOf(corner);
        }
        mesh.triangles.push_back(vertices);
      }
    }
    if (!offset_) {
      Box3d bounds;
      for (const Vec3d& p : positions_) bounds.Extend(p);
      offset_ = OffsetFor(bounds);
    }
    std::vector<Rgb> colors;
    for (const MeshCorner& corner : index.corners()) {
      mesh.positions.push_back(Vec3f(positions_[corner.position] - *offset_));
      if (part.has_uv) mesh.uv[0].push_back(uvs_[corner.uv]);
      if (part.has_normals) mesh.normals.push_back(normals_[corner.normal]);
      if (!colors_.empty()) colors.push_back(colors_[corner.position]);
    }
    if (!part.has_uv && mesh.material >= 0) NoteMissingUvs(mesh);
    if (has_smoothing_ && !part.has_normals) ++smoothed_flat_;
    if (!colors.empty()) ApplyColors(colors, mesh);
    Instance instance;
    instance.name = mesh.name;
    instance.mesh = static_cast<uint32_t>(imported_.scene.meshes.size());
    instance.world_from_mesh.translation = *offset_;
    imported_.scene.meshes.push_back(std::move(mesh));
    imported_.scene.instances.push_back(std::move(instance));
    part.faces = {};
    return absl::OkStatus();
  }

  // Colours of vertices are no part of the format but common. A material counts more.
  void ApplyColors(const std::vector<Rgb>& colors, Mesh& mesh) {
    if (mesh.material >= 0) {
      ++unused_colors_;
      return;
    }
    mesh.material = AddColorMaterial(MeanColor(mesh, colors), imported_.scene);
    ++mean_colors_;
  }

  void NoteMissingUvs(const Mesh& mesh) {
    const Material& material = imported_.scene.materials[static_cast<size_t>(mesh.material)];
    if (!material.base_color_texture.present() && !material.emission_texture.present()) return;
    if (missing_uvs_++ == 0) first_missing_uv_ = "'" + mesh.name + "'";
  }

  void AddNotes() {
    if (imported_.scene.instances.empty()) Note("the scene has no triangles");
    if (parts_.size() >= kMaxParts) {
      Note("more than " + std::to_string(kMaxParts) +
           " groups: those that follow are joined by their material");
    }
    if (skipped_lines_ > 0)
      Note(Counted(skipped_lines_, "statement") + " of points or lines skipped");
    if (skipped_faces_ > 0)
      Note(Counted(skipped_faces_, "face") + " of fewer than 3 corners skipped");
    if (crossed_faces_ > 0) {
      Note(Counted(crossed_faces_, "face") + " that cross themselves or have no area");
    }
    if (missing_uvs_ > 0) {
      Note(
          Counted(missing_uvs_, "mesh") + " (" + first_missing_uv_ +
          ") without the texture coordinates that the material needs: its texel at (0, 0) is used");
    }
    if (smoothed_flat_ > 0) Note("smoothing groups are ignored: faces without normals are flat");
    if (mean_colors_ > 0) {
      Note(Counted(mean_colors_, "mesh") + " with colours at its vertices: shown in their mean");
    }
    if (unused_colors_ > 0) Note("colours of vertices are ignored where there is a material");
    if (!ignored_.empty()) {
      std::string list;
      for (const std::string& key : ignored_) list += (list.empty() ? "" : ", ") + key;
      Note("statements ignored: " + list);
    }
    if (unknown_ > 0) {
      Note(Counted(unknown_, "statement") + " unknown and ignored, the first " + first_unknown_);
    }
  }

  const AssetBundle& asset_;
  const ImportOptions& options_;
  ImportedScene imported_;

  std::vector<Vec3d> positions_;
  std::vector<Rgb> colors_;  // empty, or one per position
  std::vector<Vec2f> uvs_;
  std::vector<Vec3f> normals_;
  std::vector<MeshCorner> corners_;
  std::optional<Vec3d> offset_;

  std::vector<Part> parts_;
  std::map<std::tuple<std::string, std::string, uint32_t, bool, bool>, uint32_t> part_index_;
  std::array<uint32_t, 4> current_part_ = {kNone, kNone, kNone, kNone};
  std::string object_, group_;

  Libraries libraries_;
  std::vector<std::string> material_names_;
  std::map<std::string, uint32_t> material_index_;
  std::map<uint32_t, uint64_t> material_lines_;
  std::vector<int32_t> scene_material_;  // by material name
  uint32_t material_ = 0;
  std::map<std::tuple<std::string, std::string, bool>, int32_t> texture_index_;

  uint64_t line_ = 0, known_statements_ = 0, unknown_ = 0, triangle_count_ = 0;
  uint64_t skipped_lines_ = 0, skipped_faces_ = 0, crossed_faces_ = 0, missing_uvs_ = 0;
  uint64_t smoothed_flat_ = 0, unused_colors_ = 0, mean_colors_ = 0, cut_out_ = 0;
  bool has_smoothing_ = false;
  std::set<std::string> ignored_;
  std::string first_unknown_, first_missing_uv_;
};

}  // namespace

absl::StatusOr<ImportedScene> ImportObj(const AssetBundle& asset, const ImportOptions& options) {
  return ObjReader(asset, options).Run();
}

absl::Status VisitObjReferences(const std::string& name, const Blob& file, AssetSource& source) {
  Libraries libraries;
  std::set<std::string> used;
  LineReader lines(TextOf(file));
  std::string_view line;
  while (lines.Next(line)) {
    std::string_view rest = line;
    const std::string_view key = NextWord(rest);
    if (key == "mtllib") libraries.emplace_back(std::string(Trim(rest)), lines.number());
    if (key == "usemtl") used.emplace(Trim(rest));
  }
  return ObjMaterials::Load(name, libraries, used, source).status();
}

}  // namespace farpoint
