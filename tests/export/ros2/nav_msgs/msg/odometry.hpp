// A stub with the fields of the message that the manual's node reads.
#pragma once
#include <memory>

namespace nav_msgs::msg {
struct Odometry {
    using ConstSharedPtr = std::shared_ptr<const Odometry>;
    struct { struct { struct { double x = 0, y = 0, z = 0; } position; struct { double x = 0, y = 0, z = 0, w = 1; } orientation; } pose; } pose;
    struct { struct { struct { double x = 0, y = 0, z = 0; } linear; } twist; } twist;
    static Odometry example() { Odometry m; m.twist.twist.linear.x = 3.0; return m; }
};
}  // namespace nav_msgs::msg
