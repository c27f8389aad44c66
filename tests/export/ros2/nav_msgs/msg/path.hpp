// A stub with the fields of the message that the manual's node reads.
#pragma once
#include <memory>
#include <vector>

namespace nav_msgs::msg {
struct Pose { struct { struct { double x = 0, y = 0, z = 0; } position; } pose; };
struct Path {
    using ConstSharedPtr = std::shared_ptr<const Path>;
    std::vector<Pose> poses;
    static Path example() {
        Path m;
        for (int k = 0; k < 15; k++) { m.poses.emplace_back(); m.poses.back().pose.position.x = 0.3 * k; }
        return m;
    }
};
}  // namespace nav_msgs::msg
