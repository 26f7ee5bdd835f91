// Bytes of zenoh keys, in a thread of zenoh-pico's.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>

namespace drivelink {

class Receiver {
public:
    // Called with each message of a key, in zenoh's thread.
    using Take = std::function<void(const uint8_t *payload, size_t length)>;

    // Throws std::runtime_error where nobody answers at the endpoint.
    explicit Receiver(const std::string &endpoint);
    ~Receiver();  // no Take is called afterwards

    // Throws std::runtime_error where it is not a key.
    void subscribe(const std::string &key, Take take);

private:
    struct Session;
    std::unique_ptr<Session> session_;
};

}  // namespace drivelink
