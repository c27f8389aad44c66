// A stub of what the manual's node uses of rclcpp: `spin` runs the timer once before anything is known, delivers a message
// of each kind, runs the timer three times, and seven times more when the messages are old.
#pragma once
#include <chrono>
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <type_traits>
#include <vector>

namespace rclcpp {
struct SensorDataQoS {
    operator int() const { return 5; }
};
struct Time {};
struct Logger {};
inline std::vector<std::function<void()>>& messages() { static std::vector<std::function<void()>> all; return all; }
inline std::vector<std::function<void()>>& timers() { static std::vector<std::function<void()>> all; return all; }

template <class M>
struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
struct TimerBase { using SharedPtr = std::shared_ptr<TimerBase>; };

template <class M>
struct Publisher {
    using SharedPtr = std::shared_ptr<Publisher>;
    void publish(const M& m) { std::printf("published %s\n", m.told().c_str()); }
};

class Node {
public:
    explicit Node(const std::string&) {}
    template <class M, class Call>
    typename Subscription<M>::SharedPtr create_subscription(const std::string&, int, Call call) {
        messages().push_back([call] { call(std::make_shared<const M>(M::example())); });
        return std::make_shared<Subscription<M>>();
    }
    template <class M>
    typename Publisher<M>::SharedPtr create_publisher(const std::string&, int) { return std::make_shared<Publisher<M>>(); }
    template <class Duration, class Call>
    TimerBase::SharedPtr create_wall_timer(Duration, Call call) {
        timers().push_back(call);
        return std::make_shared<TimerBase>();
    }
    Time now() const { return {}; }
    Logger get_logger() const { return {}; }
};

inline void init(int, char**) {}
inline void shutdown() {}
inline void spin(std::shared_ptr<Node>) {
    for (auto& timer : timers()) timer();
    for (auto& message : messages()) message();
    for (int period = 0; period < 3; period++) for (auto& timer : timers()) timer();
    std::this_thread::sleep_for(std::chrono::milliseconds(400));
    for (int period = 0; period < 7; period++) for (auto& timer : timers()) timer();
}
}  // namespace rclcpp

#define RCLCPP_WARN(logger, ...) ((void)(logger), std::printf(__VA_ARGS__), std::printf("\n"))
