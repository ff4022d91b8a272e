#include "client/nearest_name.h"
