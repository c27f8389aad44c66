// A stub with the fields of the message that the manual's node writes.
#pragma once
#include <cstdio>
#include <string>

#include "rclcpp/rclcpp.hpp"

namespace ackermann_msgs::msg {
struct AckermannDriveStamped {
    struct { rclcpp::Time stamp; } header;
    struct { float steering_angle = 0, speed = 0, acceleration = 0; } drive;
    std::string told() const {
        char text[80];
        std::snprintf(text, sizeof text, "%.3f %.3f %.3f", static_cast<double>(drive.speed),
                      static_cast<double>(drive.acceleration), static_cast<double>(drive.steering_angle));
        return text;
    }
};
}  // namespace ackermann_msgs::msg
