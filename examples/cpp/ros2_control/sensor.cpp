// Joints of drivelink as sensors of ros2_control: stiffness and external torque as state interfaces.
//
// What may not be acted upon is NaN: an estimate that is late, or that is not usable. So a controller that forgets to
// read `usable` gets no number.

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <map>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "../drivelink_wire.h"
#include "hardware_interface/sensor_interface.hpp"
#include "hardware_interface/types/hardware_interface_return_values.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "receiver.hpp"

namespace drivelink {

using hardware_interface::CallbackReturn;
using Clock = std::chrono::steady_clock;

constexpr std::array INTERFACES{"stiffness", "stiffness_std", "flexibility_torque", "usable",
                                "external_torque", "external_torque_std", "contact"};
using Values = std::array<double, INTERFACES.size()>;

// The newest messages of a joint; written by zenoh's thread, read by the controller manager's.
class Joint {
public:
    std::vector<std::pair<std::string, size_t>> wanted;  // full names of its state interfaces, and their places

    void take_estimate(const uint8_t *payload, size_t length) {
        drivelink_estimate estimate;
        if (!drivelink_decode_estimate(payload, length, &estimate)) return;
        const std::lock_guard<std::mutex> lock(mutex_);
        newest_.estimate = estimate;
        newest_.estimated = Clock::now();
    }

    void take_external(const uint8_t *payload, size_t length) {
        drivelink_external external;
        if (!drivelink_decode_external(payload, length, &external)) return;
        const std::lock_guard<std::mutex> lock(mutex_);
        newest_.external = external;
        newest_.touched = Clock::now();
    }

    // The value of each of INTERFACES; neither waits nor allocates.
    Values values(std::chrono::duration<double> stale_after) {
        if (const std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock); lock) read_ = newest_;
        const auto now = Clock::now();
        const auto &[estimate, external, estimated, touched] = read_;
        const bool usable = now - estimated <= stale_after && drivelink_usable(&estimate);
        const bool valid = now - touched <= stale_after && (external.status & DRIVELINK_EXTERNAL_VALID) != 0;
        const auto only = [](bool allowed, double number) { return allowed ? number : std::nan(""); };
        return {
            only(usable, estimate.stiffness_nm_rad),
            only(usable, estimate.stiffness_std_nm_rad),
            only(usable, estimate.flexibility_torque_nm),
            usable ? 1.0 : 0.0,
            only(valid, external.external_torque_nm),
            only(valid, external.external_torque_std_nm),
            only(valid, (external.status & DRIVELINK_EXTERNAL_CONTACT) != 0),
        };
    }

private:
    struct Newest {
        drivelink_estimate estimate{};
        drivelink_external external{};
        Clock::time_point estimated{}, touched{};
    };
    std::mutex mutex_;
    Newest newest_, read_;
};

class Sensor : public hardware_interface::SensorInterface {
public:
    CallbackReturn on_init(const hardware_interface::HardwareComponentInterfaceParams &params) override {
        if (SensorInterface::on_init(params) != CallbackReturn::SUCCESS) return CallbackReturn::ERROR;
        for (const auto &sensor : info_.sensors) {
            for (const auto &each : sensor.state_interfaces) {
                const auto found = std::find(INTERFACES.begin(), INTERFACES.end(), each.name);
                const std::string name = sensor.name + "/" + each.name;
                if (found == INTERFACES.end()) return refuse(name + ": no such state interface");
                joints_[sensor.name].wanted.emplace_back(name, found - INTERFACES.begin());
            }
        }
        try {
            stale_after_ = std::chrono::duration<double>(std::stod(parameter("stale_after_s", "0.02")));
        } catch (const std::logic_error &) {
            return refuse("stale_after_s: expected a number of seconds");
        }
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_configure(const rclcpp_lifecycle::State &) override {
        try {
            receiver_.emplace(parameter("endpoint", "tcp/127.0.0.1:7447"));
            for (auto &[name, joint] : joints_) {
                const std::string key = parameter("prefix", "drivelink") + "/" + name;
                Joint *here = &joint;
                receiver_->subscribe(key + "/estimate", [here](auto at, auto size) { here->take_estimate(at, size); });
                receiver_->subscribe(key + "/external", [here](auto at, auto size) { here->take_external(at, size); });
            }
        } catch (const std::runtime_error &error) {
            receiver_.reset();
            return refuse(error.what());
        }
        return CallbackReturn::SUCCESS;
    }

    CallbackReturn on_cleanup(const rclcpp_lifecycle::State &) override {
        receiver_.reset();
        return CallbackReturn::SUCCESS;
    }

    hardware_interface::return_type read(const rclcpp::Time &, const rclcpp::Duration &) override {
        for (auto &[_, joint] : joints_) {
            const Values values = joint.values(stale_after_);
            for (const auto &[name, index] : joint.wanted) set_state(name, values[index]);
        }
        return hardware_interface::return_type::OK;
    }

private:
    std::string parameter(const std::string &name, const std::string &otherwise) const {
        const auto found = info_.hardware_parameters.find(name);
        return found == info_.hardware_parameters.end() ? otherwise : found->second;
    }

    CallbackReturn refuse(const std::string &why) const {
        RCLCPP_ERROR(get_logger(), "drivelink: %s", why.c_str());
        return CallbackReturn::ERROR;
    }

    std::map<std::string, Joint> joints_;
    std::chrono::duration<double> stale_after_{0.02};
    std::optional<Receiver> receiver_;  // ends before the joints that it writes to
};

}  // namespace drivelink

PLUGINLIB_EXPORT_CLASS(drivelink::Sensor, hardware_interface::SensorInterface)
