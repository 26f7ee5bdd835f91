// The plugin as a controller manager drives it: main SENSOR INTERFACE,… KEY=PARAMETER… [-- KEY=HEX…]
// With messages: they are what arrives (the receiver is this file's). Without: the receiver is the real one.
#include <chrono>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <thread>

#include "hardware_interface/sensor_interface.hpp"
#include "receiver.hpp"

hardware_interface::SensorInterface *make_plugin();
using hardware_interface::CallbackReturn;

#ifndef REAL_RECEIVER
std::map<std::string, drivelink::Receiver::Take> subscribed;
struct drivelink::Receiver::Session {};
drivelink::Receiver::Receiver(const std::string &endpoint) {
    if (endpoint != "tcp/127.0.0.1:7447") throw std::runtime_error(endpoint + ": nobody answers there");
}
drivelink::Receiver::~Receiver() { subscribed.clear(); }
void drivelink::Receiver::subscribe(const std::string &key, Take take) { subscribed[key] = take; }
#endif

int main(int argc, char **argv) {
    hardware_interface::HardwareComponentInterfaceParams params;
    auto &info = params.hardware_info;
    info.sensors.push_back({argv[1], {}});
    std::istringstream interfaces(argv[2]);
    for (std::string name; std::getline(interfaces, name, ',');) info.sensors[0].state_interfaces.push_back({name});
    int k = 3;
    for (; k < argc && std::string(argv[k]) != "--"; k++) {
        const std::string pair = argv[k];
        info.hardware_parameters[pair.substr(0, pair.find('='))] = pair.substr(pair.find('=') + 1);
    }
    const std::unique_ptr<hardware_interface::SensorInterface> plugin(make_plugin());
    if (plugin->on_init(params) != CallbackReturn::SUCCESS || plugin->on_configure({}) != CallbackReturn::SUCCESS) return 1;
    const auto read = [&] {
        plugin->read({}, {});
        for (const auto &[name, value] : plugin->states) std::cout << name << ' ' << value << "  ";
        std::cout << std::endl;
    };
    read();
#ifdef REAL_RECEIVER
    for (int n = 0; n < 20; n++, std::this_thread::sleep_for(std::chrono::milliseconds(100))) read();
#else
    for (k++; k < argc; k++) {
        const std::string pair = argv[k], hexadecimal = pair.substr(pair.find('=') + 1);
        std::vector<uint8_t> payload;
        for (size_t i = 0; i < hexadecimal.size(); i += 2)
            payload.push_back(static_cast<uint8_t>(std::stoul(hexadecimal.substr(i, 2), nullptr, 16)));
        subscribed.at(pair.substr(0, pair.find('=')))(payload.data(), payload.size());
        read();
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(300));
    read();
#endif
    return plugin->on_cleanup({}) != CallbackReturn::SUCCESS;
}
