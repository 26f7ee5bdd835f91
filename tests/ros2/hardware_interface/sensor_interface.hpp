// What examples/cpp/ros2_control uses of ros2_control (as in its branch jazzy), without ROS.
#pragma once
#include <map>
#include <string>
#include <unordered_map>
#include <vector>

#include "hardware_interface/types/hardware_interface_return_values.hpp"
#include "rclcpp/rclcpp.hpp"

namespace rclcpp_lifecycle {
class State {};
}  // namespace rclcpp_lifecycle

namespace hardware_interface {

enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
struct InterfaceInfo { std::string name; };
struct ComponentInfo {
    std::string name;
    std::vector<InterfaceInfo> state_interfaces;
};
struct HardwareInfo {
    std::unordered_map<std::string, std::string> hardware_parameters;
    std::vector<ComponentInfo> sensors;
};
struct HardwareComponentInterfaceParams { HardwareInfo hardware_info; };

class SensorInterface {
public:
    virtual ~SensorInterface() = default;
    virtual CallbackReturn on_init(const HardwareComponentInterfaceParams &params) {
        info_ = params.hardware_info;
        return CallbackReturn::SUCCESS;
    }
    virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
    virtual CallbackReturn on_cleanup(const rclcpp_lifecycle::State &) { return CallbackReturn::SUCCESS; }
    virtual return_type read(const rclcpp::Time &, const rclcpp::Duration &) = 0;
    virtual rclcpp::Logger get_logger() const { return {}; }
    template <typename T>
    void set_state(const std::string &interface_name, const T &value) { states[interface_name] = value; }

    std::map<std::string, double> states;

protected:
    HardwareInfo info_;
};

}  // namespace hardware_interface
