#include "core/accel/accel_version.h"

#if __has_include(<embree4/rtcore.h>)
#include <embree4/rtcore.h>
#else
#include <embree3/rtcore.h>
#endif

namespace farpoint {

absl::StatusOr<std::string> AccelVersion() {
  const RTCDevice device = rtcNewDevice("isa=avx2,threads=1");
  if (device == nullptr) {
    return absl::UnavailableError("Embree gave no device (rtcNewDevice error " +
                                  std::to_string(static_cast<int>(rtcGetDeviceError(nullptr))) +
                                  ")");
  }
  const auto part = [device](RTCDeviceProperty property) {
    return std::to_string(rtcGetDeviceProperty(device, property));
  };
  const std::string version = "embree " + part(RTC_DEVICE_PROPERTY_VERSION_MAJOR) + "." +
                              part(RTC_DEVICE_PROPERTY_VERSION_MINOR) + "." +
                              part(RTC_DEVICE_PROPERTY_VERSION_PATCH);
  rtcReleaseDevice(device);
  return version;
}

}  // namespace farpoint
