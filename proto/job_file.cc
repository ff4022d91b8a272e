// The job file. protobuf's own messages name neither path nor allowed values, so the text is held
// against the message's description first.
#include <google/protobuf/descriptor.h>
#include <google/protobuf/util/json_util.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/base/nearest_name.h"
#include "proto/convert.h"

namespace farpoint {

namespace {

using google::protobuf::Descriptor;
using google::protobuf::FieldDescriptor;
using Json = nlohmann::json;

constexpr size_t kShownBytes = 60;

// A value as a message shows it: short, and UTF-8 whatever the file held.
std::string Shown(const Json& value) {
  if (value.is_object()) return "an object";
  if (value.is_array()) return "a list";
  std::string text = value.dump(-1, ' ', false, Json::error_handler_t::replace);
  if (text.size() > kShownBytes) text = text.substr(0, kShownBytes) + "…";
  return text;
}

absl::Status Bad(const std::string& path, const Json& value, const std::string& allowed) {
  return absl::InvalidArgumentError(path + " is " + Shown(value) + "; allowed: " + allowed);
}

// protobuf takes numbers in quotes, too, since JavaScript cannot hold all 64 bits.
bool IntegerWithin(const Json& value, int64_t min, uint64_t max) {
  if (value.is_number_unsigned()) return value.get<uint64_t>() <= max;
  if (value.is_number_integer()) return value.get<int64_t>() >= min && value.get<int64_t>() < 0;
  if (value.is_number_float()) {
    const double number = value.get<double>();
    return number == std::floor(number) && number >= static_cast<double>(min) &&
           number <= static_cast<double>(max);
  }
  if (!value.is_string()) return false;
  const std::string& text = value.get_ref<const std::string&>();
  const char* const end = text.data() + text.size();
  uint64_t positive = 0;
  auto read = std::from_chars(text.data(), end, positive);
  if (read.ec == std::errc() && read.ptr == end) return positive <= max;
  int64_t number = 0;
  read = std::from_chars(text.data(), end, number);
  return read.ec == std::errc() && read.ptr == end && number >= min && number < 0;
}

absl::Status CheckInteger(const Json& value, const std::string& path, int64_t min, uint64_t max) {
  if (IntegerWithin(value, min, max)) return absl::OkStatus();
  return Bad(path, value,
             "a whole number from " + std::to_string(min) + " to " + std::to_string(max));
}

absl::Status CheckReal(const Json& value, const std::string& path, double max) {
  if (value.is_number()) {
    const double number = value.get<double>();
    if (std::abs(number) <= max) return absl::OkStatus();
  } else if (value.is_string()) {
    const std::string& text = value.get_ref<const std::string&>();
    double number = 0;
    const auto read = std::from_chars(text.data(), text.data() + text.size(), number);
    if (read.ec == std::errc() && read.ptr == text.data() + text.size() &&
        std::abs(number) <= max) {
      return absl::OkStatus();
    }
  }
  return Bad(path, value, "a finite number");
}

absl::Status CheckEnum(const Json& value, const std::string& path, const FieldDescriptor& field) {
  const google::protobuf::EnumDescriptor& type = *field.enum_type();
  std::vector<std::string> names;
  std::string allowed;
  for (int i = 0; i < type.value_count(); ++i) {
    if (type.value(i)->number() == 0) continue;  // UNSPECIFIED is what is left out
    names.push_back(type.value(i)->name());
    allowed += (allowed.empty() ? "" : ", ") + names.back();
  }
  if (value.is_string()) {
    const std::string& name = value.get_ref<const std::string&>();
    if (type.FindValueByName(name) != nullptr) return absl::OkStatus();
    std::string upper = name;
    std::transform(upper.begin(), upper.end(), upper.begin(),
                   [](unsigned char c) { return static_cast<char>(std::toupper(c)); });
    const std::string nearest = NearestName(upper, names);
    if (!nearest.empty()) allowed += "; did you mean " + nearest + "?";
  } else if (value.is_number_integer() && IntegerWithin(value, 0, 1 << 20) &&
             type.FindValueByNumber(value.get<int>()) != nullptr) {
    return absl::OkStatus();
  }
  return Bad(path, value, allowed);
}

absl::Status CheckMessage(const Json& value, const std::string& path, const Descriptor& type);

absl::Status CheckValue(const Json& value, const std::string& path, const FieldDescriptor& field) {
  switch (field.cpp_type()) {
    case FieldDescriptor::CPPTYPE_INT32:
      return CheckInteger(value, path, std::numeric_limits<int32_t>::min(),
                          std::numeric_limits<int32_t>::max());
    case FieldDescriptor::CPPTYPE_INT64:
      return CheckInteger(value, path, std::numeric_limits<int64_t>::min(),
                          std::numeric_limits<int64_t>::max());
    case FieldDescriptor::CPPTYPE_UINT32:
      return CheckInteger(value, path, 0, std::numeric_limits<uint32_t>::max());
    case FieldDescriptor::CPPTYPE_UINT64:
      return CheckInteger(value, path, 0, std::numeric_limits<uint64_t>::max());
    case FieldDescriptor::CPPTYPE_DOUBLE:
      return CheckReal(value, path, std::numeric_limits<double>::max());
    case FieldDescriptor::CPPTYPE_FLOAT:
      return CheckReal(value, path, std::numeric_limits<float>::max());
    case FieldDescriptor::CPPTYPE_BOOL:
      return value.is_boolean() ? absl::OkStatus() : Bad(path, value, "true or false");
    case FieldDescriptor::CPPTYPE_STRING:
      return value.is_string() ? absl::OkStatus() : Bad(path, value, "a text in quotes");
    case FieldDescriptor::CPPTYPE_ENUM:
      return CheckEnum(value, path, field);
    case FieldDescriptor::CPPTYPE_MESSAGE:
      return CheckMessage(value, path, *field.message_type());
  }
  return absl::OkStatus();
}

// As deep as the message's description is: it does not contain itself.
absl::Status CheckMessage(const Json& value, const std::string& path, const Descriptor& type) {
  std::vector<std::string> names;
  for (int i = 0; i < type.field_count(); ++i) names.push_back(type.field(i)->name());
  if (!value.is_object()) {
    std::string allowed;
    for (const std::string& name : names) allowed += (allowed.empty() ? "" : ", ") + name;
    return Bad(path.empty() ? "the file's content" : path, value, "an object with " + allowed);
  }
  const FieldDescriptor* in_oneof = nullptr;
  for (const auto& [key, member] : value.items()) {
    const FieldDescriptor* field = type.FindFieldByName(key);
    if (field == nullptr) field = type.FindFieldByCamelcaseName(key);
    const std::string below = path.empty() ? key : path + "." + key;
    if (field == nullptr) {
      std::string known = NearestName(key, names);
      if (known.empty()) {
        for (const std::string& name : names) known += (known.empty() ? "" : ", ") + name;
        known = "; known here: " + known;
      } else {
        known = "; did you mean '" + known + "'?";
      }
      return absl::InvalidArgumentError(below + " is not a known field" + known);
    }
    if (member.is_null()) continue;  // as if it were absent
    if (field->real_containing_oneof() != nullptr) {
      if (in_oneof != nullptr) {
        return absl::InvalidArgumentError(below + " and '" + in_oneof->name() +
                                          "' exclude each other; leave one out");
      }
      in_oneof = field;
    }
    if (!field->is_repeated()) {
      FP_RETURN_IF_ERROR(CheckValue(member, below, *field));
      continue;
    }
    if (!member.is_array()) return Bad(below, member, "a list in brackets");
    for (size_t i = 0; i < member.size(); ++i) {
      FP_RETURN_IF_ERROR(CheckValue(member[i], below + "[" + std::to_string(i) + "]", *field));
    }
  }
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<v1::RenderJob> RenderJobFromJson(std::string_view text, std::string_view name) {
  const std::string file = "'" + std::string(name) + "' is not a job file";
  // A byte order mark, as some editors write it.
  if (text.starts_with("\xEF\xBB\xBF")) text.remove_prefix(3);
  Json json;
  try {
    json = Json::parse(text.begin(), text.end());
  } catch (const Json::exception& e) {
    return absl::InvalidArgumentError(file + ": " + e.what() + "; correct the file there");
  }
  FP_RETURN_IF_ERROR(Annotate(CheckMessage(json, "", *v1::RenderJob::descriptor()), file));
  v1::RenderJob job;
  const auto status = google::protobuf::util::JsonStringToMessage(
      google::protobuf::StringPiece(text.data(), text.size()), &job);
  if (status.ok()) return job;
  std::string message(status.message().data(), status.message().size());
  std::replace(message.begin(), message.end(), '\n', ' ');
  return absl::InvalidArgumentError(file + ": " + message);
}

std::string RenderJobToJson(const v1::RenderJob& job) {
  google::protobuf::util::JsonPrintOptions options;
  options.add_whitespace = true;
  options.preserve_proto_field_names = true;
  std::string text;
  // Fails only for messages that hold an Any of an unknown type; ours hold none.
  (void)google::protobuf::util::MessageToJsonString(job, &text, options);
  return text;
}

}  // namespace farpoint
