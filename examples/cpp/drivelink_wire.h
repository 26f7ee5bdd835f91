/* The bytes of <prefix>/<joint>/estimate and /external, in C99 and C++, without any library.
 *
 * Zenoh-serialized: packed, little-endian; the transmissions are a sequence, its length a LEB128 varint.
 * Works on any host byte order and alignment, allocates nothing.
 */
#ifndef DRIVELINK_WIRE_H
#define DRIVELINK_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

enum {
    DRIVELINK_VALID = 1 << 0,      /* the numbers may be used */
    DRIVELINK_OBSERVABLE = 1 << 1, /* the motion reveals the stiffness */
    DRIVELINK_MODEL_ALARM = 1 << 4, /* the model is not sufficient */
    /* What must be clear beside it: model alarm, restarted, drive fault, stale, untimed, node restarted,
     * contradicted. */
    DRIVELINK_AGAINST = 1 << 4 | 1 << 6 | 1 << 8 | 1 << 10 | 1 << 11 | 1 << 12 | 1 << 14,
    DRIVELINK_PARTIAL = 1 << 13,   /* what is NaN is not given: a rigid joint's stiffness, mode paper's std */
    DRIVELINK_MAX_TRANSMISSIONS = 8
};

typedef struct {
    double flexibility_torque_nm;
    double stiffness_nm_rad;
    double stiffness_std_nm_rad;
    double deflection_rad;
} drivelink_transmission;

typedef struct {
    uint64_t sequence;
    uint64_t stamp_ns; /* UNIX time of the SYNC */
    uint32_t status;
    double flexibility_torque_nm;
    double stiffness_nm_rad;
    double stiffness_std_nm_rad;
    size_t transmissions;
    drivelink_transmission transmission[DRIVELINK_MAX_TRANSMISSIONS];
} drivelink_estimate;

/* What the world does to the link; its status is of its own. */
enum {
    DRIVELINK_EXTERNAL_VALID = 1 << 0,   /* the numbers may be used */
    DRIVELINK_EXTERNAL_CONTACT = 1 << 1, /* something touches the link; only where valid */
    DRIVELINK_EXTERNAL_BYTES = 8 + 8 + 4 + 2 * 8
};

typedef struct {
    uint64_t sequence;
    uint64_t stamp_ns; /* UNIX time of the SYNC */
    uint32_t status;
    double external_torque_nm;
    double external_torque_std_nm;
} drivelink_external;

static inline uint64_t drivelink_unsigned(const uint8_t **at, size_t bytes) {
    uint64_t value = 0;
    for (size_t i = 0; i < bytes; i++) value |= (uint64_t)(*at)[i] << (8 * i);
    *at += bytes;
    return value;
}

static inline double drivelink_double(const uint8_t **at) {
    const uint64_t bits = drivelink_unsigned(at, 8);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline bool drivelink_finite(double number) { return number - number == 0.0; }

/* A stiffness or standard deviation: finite and not negative, or NaN where the status says that it is not given. */
static inline bool drivelink_magnitude(double number, uint32_t status) {
    return (drivelink_finite(number) && number >= 0.0) || ((status & DRIVELINK_PARTIAL) != 0 && number != number);
}

/* Whether every number is one that a joint can have. */
static inline bool drivelink_plausible(const drivelink_estimate *estimate) {
    const uint32_t status = estimate->status;
    bool good = drivelink_finite(estimate->flexibility_torque_nm) &&
                drivelink_magnitude(estimate->stiffness_nm_rad, status) &&
                drivelink_magnitude(estimate->stiffness_std_nm_rad, status);
    for (size_t i = 0; good && i < estimate->transmissions; i++) {
        const drivelink_transmission *one = &estimate->transmission[i];
        const double deflection = one->deflection_rad;
        good = drivelink_finite(one->flexibility_torque_nm) && drivelink_magnitude(one->stiffness_nm_rad, status) &&
               drivelink_magnitude(one->stiffness_std_nm_rad, status) &&
               (drivelink_finite(deflection) || ((status & DRIVELINK_PARTIAL) != 0 && deflection != deflection));
    }
    return good;
}

/* Read a payload into *estimate. False, and nothing to be used, for anything that is no estimate, or that is called
 * valid and holds a number that no joint has: not finite, or a negative stiffness. Not for -ffast-math. */
static inline bool drivelink_decode_estimate(const uint8_t *payload, size_t length, drivelink_estimate *estimate) {
    const size_t head = 8 + 8 + 4 + 3 * 8, element = 4 * 8;
    if (length < head + 1) return false;
    const uint8_t *at = payload;
    estimate->sequence = drivelink_unsigned(&at, 8);
    estimate->stamp_ns = drivelink_unsigned(&at, 8);
    estimate->status = (uint32_t)drivelink_unsigned(&at, 4);
    estimate->flexibility_torque_nm = drivelink_double(&at);
    estimate->stiffness_nm_rad = drivelink_double(&at);
    estimate->stiffness_std_nm_rad = drivelink_double(&at);
    const size_t count = *at++; /* the varint is one byte below 128 */
    if (count > DRIVELINK_MAX_TRANSMISSIONS || length != head + 1 + count * element) return false;
    estimate->transmissions = count;
    for (size_t i = 0; i < count; i++) {
        estimate->transmission[i].flexibility_torque_nm = drivelink_double(&at);
        estimate->transmission[i].stiffness_nm_rad = drivelink_double(&at);
        estimate->transmission[i].stiffness_std_nm_rad = drivelink_double(&at);
        estimate->transmission[i].deflection_rad = drivelink_double(&at);
    }
    return (estimate->status & DRIVELINK_VALID) == 0 || drivelink_plausible(estimate);
}

/* Read a payload into *external. False, and nothing to be used, for anything that is no external torque, that is
 * called valid and holds what is not finite or a negative standard deviation, or that says contact and is not valid. */
static inline bool drivelink_decode_external(const uint8_t *payload, size_t length, drivelink_external *external) {
    if (length != DRIVELINK_EXTERNAL_BYTES) return false;
    const uint8_t *at = payload;
    external->sequence = drivelink_unsigned(&at, 8);
    external->stamp_ns = drivelink_unsigned(&at, 8);
    external->status = (uint32_t)drivelink_unsigned(&at, 4);
    external->external_torque_nm = drivelink_double(&at);
    external->external_torque_std_nm = drivelink_double(&at);
    if ((external->status & DRIVELINK_EXTERNAL_VALID) == 0)
        return (external->status & DRIVELINK_EXTERNAL_CONTACT) == 0;
    return drivelink_finite(external->external_torque_nm) && drivelink_magnitude(external->external_torque_std_nm, 0);
}

/* Whether the numbers may be used. */
static inline bool drivelink_valid(const drivelink_estimate *estimate) {
    return (estimate->status & DRIVELINK_VALID) != 0;
}

/* What a controller checks of an estimate that is fresh: valid, and nothing in its status speaks against it. */
static inline bool drivelink_usable(const drivelink_estimate *estimate) {
    return (estimate->status & (DRIVELINK_VALID | DRIVELINK_AGAINST)) == DRIVELINK_VALID;
}

#ifdef __cplusplus
}
#endif
#endif
