#include <sys/mman.h>
#include <unistd.h>

#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <limits>
#include <string>
#include <utility>

#include "core/base/blob.h"
#include "core/base/executor.h"
#include "core/image/exr_io.h"
#include "core/image/film.h"
#include "core/image/npy_io.h"
#include "core/image/png_io.h"
#include "core/render/bake.h"
#include "core/render/frame_renderer.h"
#include "core/scene/environment_image.h"
#include "core/scene/hdr_decode.h"
#include "core/scene/image_decode.h"
#include "core/scene/importer.h"
#include "core/scene/prepared_scene.h"
#include "core/scene/procedural.h"
#include "core/scene/quad_mesh.h"
#include "tests/fuzz/fuzz_target.h"

namespace farpoint {

namespace {

constexpr int64_t kMaxPixels = 1 << 18;

Executor& OneThread() {
  static Executor executor(1);
  return executor;
}

FuzzBytes BytesOfFile(const std::string& path) {
  const Blob blob = ReadFile(path).value();
  return {blob.bytes().begin(), blob.bytes().end()};
}

// A folder that ends with its scope.
class SeedFolder {
 public:
  SeedFolder() {
    static std::atomic<int> count{0};
    path_ = std::filesystem::temp_directory_path() /
            ("farpoint-fuzz-" + std::to_string(::getpid()) + "-" + std::to_string(count++));
    std::filesystem::create_directories(path_);
  }
  ~SeedFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  std::string operator/(const char* name) const { return (path_ / name).string(); }

 private:
  std::filesystem::path path_;
};

// A room of two quads, a mask and a lamp: all that a scene can have, and small.
Scene SmallScene() {
  Scene scene;
  scene.materials = {LambertMaterial("floor", Rgb(0.7f)),
                     LambertMaterial("lamp", Rgb(0.2f), Rgb(5, 4, 3)),
                     LambertMaterial("leaf", {0.3f, 0.6f, 0.2f})};
  AddQuads("floor", 0, {{{{-1, 0, 1}, {1, 0, 1}, {1, 0, -1}, {-1, 0, -1}}}}, scene);
  AddQuads("lamp", 1, {{{{0.2f, 1, 0.1f}, {0.2f, 1, 0}, {0.1f, 1, 0}, {0.1f, 1, 0.1f}}}}, scene);
  Mesh leaf =
      MeshOfQuads("leaf", 2, {{{{-0.5f, 0.2f, 0}, {0, 0.2f, 0}, {0, 0.7f, 0}, {-0.5f, 0.7f, 0}}}});
  leaf.normals.assign(leaf.positions.size(), Vec3f(0, 0, 1));
  leaf.uv[0] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
  scene.instances.push_back({"leaf", static_cast<uint32_t>(scene.meshes.size()), {}});
  scene.meshes.push_back(std::move(leaf));
  Texture texture;
  texture.name = "leaf.png";
  texture.encoded =
      EncodePng(DecodedImage{2, 2, {0xff0000ffu, 0x0000ff00u, 0xffffff00u, 0xff808080u}});
  scene.textures.push_back(std::move(texture));
  scene.materials[2].base_color_texture.texture = 0;
  scene.materials[2].alpha_mode = AlphaMode::kMask;
  PunctualLight spot;
  spot.name = "spot";
  spot.kind = PunctualKind::kSpot;
  spot.position = {0, 1.5, 0.5};
  spot.direction = {0, -1, 0};
  spot.intensity = Rgb(3);
  spot.range_m = 5;
  scene.lights.push_back(std::move(spot));
  scene.environment.sky = Rgb(0.1f);
  Camera camera;
  camera.name = "camera";
  camera.eye = {0, 0.5, 2};
  scene.cameras.push_back(camera);
  return scene;
}

RenderSettings SmallSettings(Integrator integrator) {
  RenderSettings s;
  s.integrator = integrator;
  s.points = 64;
  s.paths = 8;
  s.light_samples = 4;
  s.microbuffer = 8;
  return s;
}

// Renders a few pixels of a scene that was read: what readers accept, kernels must bear. Only
// refusals that name the scene's own fault are allowed.
void RenderSome(const BakedScene& baked, Integrator integrator) {
  const auto loaded = LoadedScene::Load(baked, OneThread());
  if (!loaded.ok()) return;
  const FilmSpec film{4, 4, {0, 0, 4, 4}};
  const auto renderer =
      FrameRenderer::Create(*loaded, {SmallScene().cameras[0], film, SmallSettings(integrator)});
  if (!renderer.ok()) {
    FuzzRequire(absl::IsInvalidArgument(renderer.status()), "only the camera may be too far away");
    return;
  }
  const auto tile = (*renderer)->RenderTile(film.crop, OneThread(), {}, nullptr);
  FuzzRequire(tile.ok(), "no scene makes a value that is not finite");
}

// --- Scenes ---

bool Import(const AssetBundle& asset) {
  ImportOptions options;
  options.max_triangles = 100'000;
  auto imported = ImportScene(asset, options);
  (void)FindAnimation(asset);
  if (!imported.ok()) return false;
  EnsureCameraAndLight(*imported, false);
  (void)PreparedScene::Prepare(imported->scene, OneThread());
  return true;
}

bool RunGltf(std::span<const std::byte> bytes) {
  return Import({"scene.gltf", {{"scene.gltf", Blob::FromString(TextOf(bytes))}}});
}
bool RunGlb(std::span<const std::byte> bytes) {
  return Import({"scene.glb", {{"scene.glb", Blob::FromString(TextOf(bytes))}}});
}
bool RunPly(std::span<const std::byte> bytes) {
  return Import({"scene.ply", {{"scene.ply", Blob::FromString(TextOf(bytes))}}});
}
// The OBJ up to the first zero byte, then its material library.
bool RunObj(std::span<const std::byte> bytes) {
  const std::string_view text = TextOf(bytes);
  const size_t end = std::min(text.find('\0'), text.size());
  return Import({"scene.obj",
                 {{"scene.obj", Blob::FromString(text.substr(0, end))},
                  {"scene.mtl", Blob::FromString(text.substr(std::min(end + 1, text.size())))}}});
}

std::string Base64Of(std::span<const std::byte> bytes) {
  constexpr std::string_view kDigits =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string out;
  for (size_t i = 0; i < bytes.size(); i += 3) {
    uint32_t v = 0;
    for (size_t k = 0; k < 3; ++k) {
      v = v << 8 | (i + k < bytes.size() ? std::to_integer<uint32_t>(bytes[i + k]) : 0u);
    }
    for (size_t k = 0; k < 4; ++k) {
      out += i + k <= bytes.size() ? kDigits[(v >> (18 - 6 * k)) & 63] : '=';
    }
  }
  return out;
}

std::vector<FuzzBytes> GlbSeeds() {
  const SeedFolder folder;
  std::vector<FuzzBytes> seeds;
  for (const Scene& scene : {SmallScene(), MakeCornellBox()}) {
    if (!WriteGltf(scene, folder / "a.glb").ok()) std::abort();
    seeds.push_back(BytesOfFile(folder / "a.glb"));
  }
  return seeds;
}

std::vector<FuzzBytes> GltfSeeds() {
  // The writer's JSON with its buffer inside, and a file with what the writer does not write:
  // animation, skin, morph targets, a sparse accessor.
  const SeedFolder folder;
  if (!WriteGltf(SmallScene(), folder / "a.gltf").ok()) std::abort();
  std::string json{TextOf(BytesOfFile(folder / "a.gltf"))};
  const std::string buffer =
      "data:application/octet-stream;base64," + Base64Of(BytesOfFile(folder / "a.bin"));
  if (const size_t at = json.find("a.bin"); at != std::string::npos) json.replace(at, 5, buffer);
  std::vector<float> floats = {0, 0, 0, 1, 0, 0,    0, 1,   0,  // positions, and morph offsets
                               0, 1,                            // times
                               0, 0, 0, 1, 0, 0.6f, 0, 0.8f};   // rotations
  const std::string bin = Base64Of(std::as_bytes(std::span(floats)));
  const std::string animated =
      R"({"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0,1]}],)"
      R"("nodes":[{"mesh":0,"skin":0,"weights":[0.5]},{"name":"joint","rotation":[0,0,0,1]}],)"
      R"("skins":[{"joints":[1]}],)"
      R"("meshes":[{"primitives":[{"attributes":{"POSITION":0},"targets":[{"POSITION":0}],"mode":4}]}],)"
      R"("animations":[{"samplers":[{"input":1,"output":2,"interpolation":"LINEAR"}],)"
      R"("channels":[{"sampler":0,"target":{"node":1,"path":"rotation"}}]}],)"
      R"("accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]},)"
      R"({"bufferView":1,"componentType":5126,"count":2,"type":"SCALAR","min":[0],"max":[1]},)"
      R"({"bufferView":2,"componentType":5126,"count":2,"type":"VEC4"}],)"
      R"("bufferViews":[{"buffer":0,"byteLength":36},{"buffer":0,"byteOffset":36,"byteLength":8},)"
      R"({"buffer":0,"byteOffset":44,"byteLength":32}],)"
      R"("buffers":[{"byteLength":76,"uri":"data:application/octet-stream;base64,)" +
      bin + R"("}]})";
  return {BytesOf(json), BytesOf(animated)};
}

std::vector<FuzzBytes> ObjSeeds() {
  return {
      BytesOf("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
      BytesOf(std::string("# a box's side\nmtllib scene.mtl\no wall\nusemtl lamp\n"
                          "v 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
                          "vn 0 0 1\ng a b\ns 1\nf 1/1/1 2/2/1 3/3/1 -1/-1/-1\n"
                          "f 1//1 2//1 \\\n 3//1\nl 1 2\n") +
              '\0' +
              "newmtl lamp\nKd 0.5 .4 0.3\nKe 1 2 3\nd 0.5\nillum 2\n\nnewmtl other\nKd 1 1 1\n")};
}

std::vector<FuzzBytes> PlySeeds() {
  const std::string head =
      " 1.0\ncomment seed\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
      "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
  std::string binary = "ply\nformat binary_little_endian" + head;
  std::string big = "ply\nformat binary_big_endian" + head;
  const auto add = [&](auto value) {
    std::array<char, sizeof(value)> raw;
    std::memcpy(raw.data(), &value, sizeof(value));
    binary.append(raw.data(), raw.size());
    big.append(raw.rbegin(), raw.rend());
  };
  for (const float v : {0.f, 0.f, 0.f, 1.f, 0.f, 0.f, 1.f, 1.f, 0.f, 0.f, 1.f, 0.f}) add(v);
  add(uint8_t{4});
  for (const int32_t i : {0, 1, 2, 3}) add(i);
  return {BytesOf("ply\nformat ascii" + head + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n"),
          BytesOf(binary), BytesOf(big)};
}

// --- Images ---

bool RunHdr(std::span<const std::byte> bytes) {
  Environment environment;
  const bool loaded =
      LoadEnvironmentMap(Blob::FromString(TextOf(bytes)), "map.hdr", environment).ok();
  const auto image = DecodeHdr("map.hdr", bytes, kMaxPixels);
  if (!image.ok()) return false;
  FuzzRequire(image->pixels.size() == size_t{image->width} * image->height, "all pixels are there");
  for (const Rgb& c : image->pixels) {
    FuzzRequire(IsFinite(c) && c.x >= 0 && c.y >= 0 && c.z >= 0, "Radiance files hold no other");
  }
  return loaded || image.ok();
}

std::vector<FuzzBytes> HdrSeeds() {
  std::string flat = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n-Y 2 +X 3\n";
  for (int i = 0; i < 6; ++i) flat += std::string("\x80\x40\x20\x81", 4);
  // New run-length scheme: 8 pixels wide, four planes, a run and literals.
  std::string rle = "#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 8\n";
  rle += std::string("\x02\x02\x00\x08", 4);
  for (int plane = 0; plane < 4; ++plane) rle += std::string("\x86\x90\x02\x11\x22", 5);
  return {BytesOf(flat), BytesOf(rle)};
}

bool RunExr(std::span<const std::byte> bytes) {
  const auto rgb = ReadExrRgb(bytes, "fuzz.exr", kMaxPixels);
  if (rgb.ok()) {
    FuzzRequire(rgb->pixels.size() == size_t{rgb->width} * rgb->height, "all pixels are there");
    Environment environment;
    (void)LoadEnvironmentMap(Blob::FromString(TextOf(bytes)), "map.exr", environment);
  }
  // Whole images are read only if a small one was announced: files may hold gigapixels of one
  // value.
  if (!rgb.ok()) return false;
  const auto image = ReadExr(bytes, "fuzz.exr");
  if (image.ok()) (void)FilmFromExr(*image);
  return true;
}

Film SmallFilm() {
  Film film({32, 0, 35, 2}, {Layer::kBeauty, Layer::kDepth, Layer::kIrradiance});
  for (int y = 0; y < 2; ++y) {
    for (int x = 32; x < 35; ++x) {
      const float f = static_cast<float>(x + y);
      film.Set(Layer::kBeauty, x, y, std::array{f, 0.5f * f, 0.25f, 1.0f});
      film.Set(Layer::kDepth, x, y,
               std::array{x == 33 ? std::numeric_limits<float>::infinity() : f});
      film.Set(Layer::kIrradiance, x, y, std::array{f, f, f});
    }
  }
  film.RoundToStorage();
  return film;
}

std::vector<FuzzBytes> ExrSeeds() {
  const SeedFolder folder;
  std::vector<FuzzBytes> seeds;
  ExrMetadata metadata;
  metadata.strings["farpoint:version"] = "seed";
  metadata.matrices["worldToCamera"] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  metadata.frames_per_second = 24;
  for (const ExrCompression c : {ExrCompression::kNone, ExrCompression::kRle, ExrCompression::kZip,
                                 ExrCompression::kPiz, ExrCompression::kDwaa}) {
    if (!WriteExr(folder / "a.exr", SmallFilm(), 64, 64, metadata, c).ok()) std::abort();
    seeds.push_back(BytesOfFile(folder / "a.exr"));
  }
  return seeds;
}

bool RunImage(std::span<const std::byte> bytes) {
  const auto size = ReadImageSize("fuzz.png", bytes);
  if (!size.ok() || int64_t{size->width} * size->height > kMaxPixels) return false;
  const auto image = DecodeImage("fuzz.png", bytes);
  if (!image.ok()) return false;
  FuzzRequire(image->width == size->width && image->height == size->height,
              "the header's size is the image's");
  FuzzRequire(image->texels.size() == size_t{image->width} * image->height, "all texels are there");
  return true;
}

std::vector<FuzzBytes> ImageSeeds() {
  const Blob rgba = EncodePng(DecodedImage{2, 2, {0xff0000ffu, 0x80ff0000u, 0xffffffffu, 0u}});
  const std::array<uint8_t, 9> rgb = {255, 0, 0, 0, 255, 0, 0, 0, 255};
  // 8 x 8 grey texels, written by libjpeg: the project writes no JPEG.
  constexpr char kJpeg[] =
      "\xff\xd8\xff\xe0\x00\x10\x4a\x46\x49\x46\x00\x01\x01\x00\x00\x01\x00\x01\x00\x00\xff"
      "\xdb\x00\x43\x00\x03\x02\x02\x03\x02\x02\x03\x03\x03\x03\x04\x03\x03\x04\x05\x08\x05"
      "\x05\x04\x04\x05\x0a\x07\x07\x06\x08\x0c\x0a\x0c\x0c\x0b\x0a\x0b\x0b\x0d\x0e\x12\x10"
      "\x0d\x0e\x11\x0e\x0b\x0b\x10\x16\x10\x11\x13\x14\x15\x15\x15\x0c\x0f\x17\x18\x16\x14"
      "\x18\x12\x14\x15\x14\xff\xc0\x00\x0b\x08\x00\x08\x00\x08\x01\x01\x11\x00\xff\xc4\x00"
      "\x14\x00\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x07\xff\xc4"
      "\x00\x14\x10\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00\xff"
      "\xda\x00\x08\x01\x01\x00\x00\x3f\x00\x1a\x7f\xff\xd9";
  return {BytesOf({kJpeg, sizeof(kJpeg) - 1}),
          {rgba.bytes().begin(), rgba.bytes().end()},
          EncodePng(3, 1, rgb).value()};
}

// A file that lives in memory, for readers that take a path.
class MemoryFile {
 public:
  explicit MemoryFile(std::span<const std::byte> bytes) : fd_(memfd_create("fuzz", 0)) {
    if (fd_ < 0 || ::write(fd_, bytes.data(), bytes.size()) != static_cast<ssize_t>(bytes.size())) {
      std::abort();
    }
  }
  ~MemoryFile() { ::close(fd_); }
  MemoryFile(const MemoryFile&) = delete;
  MemoryFile& operator=(const MemoryFile&) = delete;
  std::string path() const { return "/proc/self/fd/" + std::to_string(fd_); }

 private:
  int fd_;
};

bool RunNpy(std::span<const std::byte> bytes) { return ReadNpy2d(MemoryFile(bytes).path()).ok(); }

std::vector<FuzzBytes> NpySeeds() {
  const auto file = [](std::string_view type, std::string_view order, size_t value_bytes) {
    std::string header = "{'descr': '" + std::string(type) +
                         "', 'fortran_order': " + std::string(order) + ", 'shape': (2, 3), }";
    header.resize((header.size() + 10 + 64) / 64 * 64 - 10, ' ');
    header.back() = '\n';
    std::string text("\x93NUMPY\x01\x00", 8);
    text += static_cast<char>(header.size() & 255);
    text += static_cast<char>(header.size() >> 8);
    return BytesOf(text + header + std::string(6 * value_bytes, '\0'));
  };
  return {file("<f4", "False", 4), file("|b1", "False", 1), file("|u1", "False", 1)};
}

// --- Blobs ---

bool RunTile(std::span<const std::byte> bytes) {
  const auto film = DecodeFilm(bytes);
  if (!film.ok()) return false;
  const std::vector<std::byte> again = EncodeFilm(*film);
  FuzzRequire(std::equal(again.begin(), again.end(), bytes.begin(), bytes.end()),
              "encoding a decoded tile gives its bytes");
  (void)ImageHash(*film);
  return true;
}

std::vector<FuzzBytes> TileSeeds() { return {EncodeFilm(SmallFilm())}; }

bool RunPreparedScene(std::span<const std::byte> bytes) {
  const Blob blob = Blob::FromString(TextOf(bytes));
  const auto scene = PreparedScene::FromBlob(blob);
  if (!scene.ok()) return false;
  for (uint32_t t = 0; t < (*scene)->triangles().size() && t < 64; ++t) {
    FuzzRequire(IsFinite((*scene)->ShadingNormal(t, 0.25f, 0.5f)), "normals are finite");
    FuzzRequire((*scene)->TriangleArea(t) >= 0, "areas are not negative");
    FuzzRequire(IsFinite((*scene)->MeanEmission(t)), "emission is finite");
  }
  if ((*scene)->triangles().size() <= 256) RenderSome({blob, {}, {}}, Integrator::kPt);
  return true;
}

std::vector<FuzzBytes> PreparedSceneSeeds() {
  std::vector<FuzzBytes> seeds;
  Scene mapped = SmallScene();
  mapped.environment.map_width = 4;
  mapped.environment.map_height = 2;
  mapped.environment.map = {Rgb(0), Rgb(1), Rgb(2), Rgb(0.1f), Rgb(0), Rgb(9), Rgb(1), Rgb(0.3f)};
  for (const Scene& scene : {SmallScene(), mapped, MakeFurnace(0.5f, 1)}) {
    const auto prepared = PreparedScene::Prepare(scene, OneThread()).value();
    seeds.emplace_back(prepared->blob().bytes().begin(), prepared->blob().bytes().end());
  }
  return seeds;
}

const BakedScene& SmallBake() {
  static const BakedScene baked = [] {
    Stats stats;
    return Bake(SmallScene(), SmallSettings(Integrator::kPbgi), OneThread(), stats).value();
  }();
  return baked;
}

// The topology's size in four bytes, the topology, the radiance.
bool RunPointTree(std::span<const std::byte> bytes) {
  uint32_t size = 0;
  if (bytes.size() < sizeof(size)) return false;
  std::memcpy(&size, bytes.data(), sizeof(size));
  bytes = bytes.subspan(sizeof(size));
  size = static_cast<uint32_t>(std::min<size_t>(size, bytes.size()));
  BakedScene baked = SmallBake();
  baked.tree_topology = Blob::FromString(TextOf(bytes.first(size)));
  baked.tree_radiance = Blob::FromString(TextOf(bytes.subspan(size)));
  if (baked.tree_topology.size() == 0 || !LoadedScene::Load(baked, OneThread()).ok()) return false;
  RenderSome(baked, Integrator::kPbgi);
  return true;
}

std::vector<FuzzBytes> PointTreeSeeds() {
  const std::span<const std::byte> topology = SmallBake().tree_topology.bytes();
  const std::span<const std::byte> radiance = SmallBake().tree_radiance.bytes();
  const auto size = static_cast<uint32_t>(topology.size());
  FuzzBytes seed(sizeof(size));
  std::memcpy(seed.data(), &size, sizeof(size));
  seed.insert(seed.end(), topology.begin(), topology.end());
  seed.insert(seed.end(), radiance.begin(), radiance.end());
  return {std::move(seed)};
}

constexpr FuzzTarget kTargets[] = {
    {"gltf", RunGltf, GltfSeeds},
    {"glb", RunGlb, GlbSeeds},
    {"obj", RunObj, ObjSeeds},
    {"ply", RunPly, PlySeeds},
    {"radiance_map", RunHdr, HdrSeeds},
    {"exr", RunExr, ExrSeeds},
    {"texture", RunImage, ImageSeeds},
    {"npy", RunNpy, NpySeeds},
    {"tile", RunTile, TileSeeds},
    {"prepared_scene", RunPreparedScene, PreparedSceneSeeds},
    {"point_tree", RunPointTree, PointTreeSeeds},
};

}  // namespace

std::span<const FuzzTarget> CoreFuzzTargets() { return kTargets; }

void FuzzRequire(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "broken promise: %s\n", what);
  std::abort();
}

FuzzBytes BytesOf(std::string_view text) {
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}

}  // namespace farpoint
