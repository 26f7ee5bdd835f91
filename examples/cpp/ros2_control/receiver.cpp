#include "receiver.hpp"

#include <zenoh-pico.h>

#include <list>
#include <stdexcept>

namespace drivelink {

struct Receiver::Session {
    z_owned_session_t session;
    std::list<Take> takes;  // their addresses are the subscribers' contexts
    std::list<z_owned_subscriber_t> subscribers;
};

namespace {

void received(z_loaned_sample_t *sample, void *context) {
    uint8_t payload[512];
    z_bytes_reader_t reader = z_bytes_get_reader(z_sample_payload(sample));
    const size_t length = z_bytes_reader_read(&reader, payload, sizeof payload);
    (*static_cast<Receiver::Take *>(context))(payload, length);
}

}  // namespace

Receiver::Receiver(const std::string &endpoint) : session_(std::make_unique<Session>()) {
    z_owned_config_t config;
    z_config_default(&config);
    zp_config_insert(z_loan_mut(config), Z_CONFIG_MODE_KEY, "client");
    zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, endpoint.c_str());
    if (z_open(&session_->session, z_move(config), nullptr) < 0)
        throw std::runtime_error(endpoint + ": nobody answers there");
    const z_loaned_session_t *session = z_loan(session_->session);
    if (!zp_read_task_is_running(session)) zp_start_read_task(z_loan_mut(session_->session), nullptr);
    if (!zp_lease_task_is_running(session)) zp_start_lease_task(z_loan_mut(session_->session), nullptr);
}

Receiver::~Receiver() {
    for (auto &subscriber : session_->subscribers) z_drop(z_move(subscriber));
    z_drop(z_move(session_->session));
}

void Receiver::subscribe(const std::string &key, Take take) {
    z_view_keyexpr_t expression;
    if (z_view_keyexpr_from_str(&expression, key.c_str()) < 0) throw std::runtime_error(key + ": not a key");
    session_->takes.push_back(std::move(take));
    z_owned_closure_sample_t closure;
    z_closure(&closure, received, nullptr, &session_->takes.back());
    session_->subscribers.emplace_back();
    if (z_declare_subscriber(z_loan(session_->session), &session_->subscribers.back(), z_loan(expression),
                             z_move(closure), nullptr) < 0) {
        session_->subscribers.pop_back();
        throw std::runtime_error(key + ": cannot be subscribed to");
    }
}

}  // namespace drivelink
