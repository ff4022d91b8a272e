// "Did you mean …", under the name by which the client's files know it.
#pragma once

#include "core/base/nearest_name.h"
