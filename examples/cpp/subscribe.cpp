// Print a joint's estimates, those missing counted, with zenoh-pico: subscribe [JOINT [ENDPOINT [COUNT]]]

#include <zenoh-pico.h>

#include <chrono>
#include <cinttypes>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "drivelink_wire.h"

namespace {

// Print one message of the key; false if it is no estimate.
bool show(const z_loaned_sample_t *sample, uint64_t *last, uint64_t *missing) {
    uint8_t payload[512];
    z_bytes_reader_t reader = z_bytes_get_reader(z_sample_payload(sample));
    const size_t length = z_bytes_reader_read(&reader, payload, sizeof payload);
    drivelink_estimate estimate;
    if (!drivelink_decode_estimate(payload, length, &estimate)) return false;
    if (*last != 0 && estimate.sequence > *last) *missing += estimate.sequence - *last - 1;
    *last = estimate.sequence;
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    const int64_t now_ns = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
    std::printf("%" PRIu64 " %.3f N·m, %.5g ± %.2g N·m/rad, valid %d, observable %d, usable %d, %" PRId64
                " µs after its SYNC, %" PRIu64 " missing\n",
                estimate.sequence, estimate.flexibility_torque_nm, estimate.stiffness_nm_rad,
                estimate.stiffness_std_nm_rad, drivelink_valid(&estimate),
                (estimate.status & DRIVELINK_OBSERVABLE) != 0, drivelink_usable(&estimate),
                (now_ns - static_cast<int64_t>(estimate.stamp_ns)) / 1000, *missing);
    return true;
}

int run(const z_loaned_session_t *session, const std::string &key, long count) {
    z_view_keyexpr_t expression;
    if (z_view_keyexpr_from_str(&expression, key.c_str()) < 0) {
        std::fprintf(stderr, "%s: not a key: expected the name of a joint\n", key.c_str());
        return 1;
    }
    z_owned_closure_sample_t closure;
    z_owned_ring_handler_sample_t handler;
    z_ring_channel_sample_new(&closure, &handler, 64);
    z_owned_subscriber_t subscriber;
    if (z_declare_subscriber(session, &subscriber, z_loan(expression), z_move(closure), nullptr) < 0) {
        std::fprintf(stderr, "%s: cannot be subscribed to\n", key.c_str());
        return 1;
    }
    uint64_t last = 0, missing = 0;
    z_owned_sample_t sample;
    while (count > 0 && z_recv(z_loan(handler), &sample) == Z_OK) {
        if (show(z_loan(sample), &last, &missing)) count--;
        std::fflush(stdout);
        z_drop(z_move(sample));
    }
    z_drop(z_move(subscriber));
    z_drop(z_move(handler));
    return count > 0;
}

}  // namespace

int main(int argc, char **argv) {
    const std::string joint = argc > 1 ? argv[1] : "elbow";
    const std::string endpoint = argc > 2 ? argv[2] : "tcp/127.0.0.1:7447";
    const long count = argc > 3 ? std::strtol(argv[3], nullptr, 10) : 1000000000L;
    if (count <= 0) {
        std::fprintf(stderr, "COUNT: expected a whole number above 0, got %s\n", argv[3]);
        return 1;
    }
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, endpoint.c_str());
    z_owned_session_t session;
    if (z_open(&session, z_move(config), nullptr) < 0) {
        std::fprintf(stderr, "%s: nobody answers there: expected a daemon (drivelink run) or a zenoh router\n", endpoint.c_str());
        return 1;
    }
    if (zp_start_read_task(z_loan_mut(session), nullptr) < 0 || zp_start_lease_task(z_loan_mut(session), nullptr) < 0) {
        std::fprintf(stderr, "zenoh-pico: its tasks do not start\n");
        return 1;
    }
    const int status = run(z_loan(session), "drivelink/" + joint + "/estimate", count);
    z_drop(z_move(session));
    return status;
}
