#pragma once
#include "ros2_double.hpp"
