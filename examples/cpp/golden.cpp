// Decode the golden byte vectors that every language reads: golden PATH_TO/tests/golden

#include <cmath>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <iterator>
#include <sstream>
#include <string>
#include <vector>

#include "drivelink_wire.h"

namespace {

std::vector<uint8_t> bytes(const std::string &hexadecimal) {
    std::vector<uint8_t> data;
    for (size_t i = 0; i < hexadecimal.size(); i += 2)
        data.push_back(static_cast<uint8_t>(std::stoul(hexadecimal.substr(i, 2), nullptr, 16)));
    return data;
}

// Equal bit by bit, every NaN being the same.
bool same(double a, const std::string &text) {
    const double b = std::strtod(text.c_str(), nullptr);
    return (std::isnan(a) && std::isnan(b)) || std::memcmp(&a, &b, sizeof a) == 0;
}

bool check(const std::vector<uint8_t> &payload, const std::vector<std::string> &numbers) {
    drivelink_estimate estimate;
    if (!drivelink_decode_estimate(payload.data(), payload.size(), &estimate)) return false;
    bool good = estimate.sequence == std::stoull(numbers[0]) && estimate.stamp_ns == std::stoull(numbers[1]) &&
                estimate.status == std::stoull(numbers[2]) && same(estimate.flexibility_torque_nm, numbers[3]) &&
                same(estimate.stiffness_nm_rad, numbers[4]) && same(estimate.stiffness_std_nm_rad, numbers[5]) &&
                estimate.transmissions == std::stoull(numbers[6]) &&
                drivelink_usable(&estimate) == ((estimate.status & 0x1d51) == 1) &&
                drivelink_valid(&estimate) == ((estimate.status & 1) == 1);
    for (size_t i = 0; good && i < estimate.transmissions; i++) {
        const std::string *group = &numbers[7 + 4 * i];
        const drivelink_transmission &each = estimate.transmission[i];
        good = same(each.flexibility_torque_nm, group[0]) && same(each.stiffness_nm_rad, group[1]) &&
               same(each.stiffness_std_nm_rad, group[2]) && same(each.deflection_rad, group[3]);
    }
    // neither a byte less nor a byte more
    auto other = payload;
    other.push_back(0);
    good = good && !drivelink_decode_estimate(other.data(), other.size(), &estimate);
    return good && !drivelink_decode_estimate(payload.data(), payload.size() - 1, &estimate);
}

bool check_external(const std::vector<uint8_t> &payload, const std::vector<std::string> &numbers) {
    drivelink_external external;
    return drivelink_decode_external(payload.data(), payload.size(), &external) &&
           external.sequence == std::stoull(numbers[0]) && external.stamp_ns == std::stoull(numbers[1]) &&
           external.status == std::stoull(numbers[2]) && same(external.external_torque_nm, numbers[3]) &&
           same(external.external_torque_std_nm, numbers[4]);
}

bool taken(const std::vector<uint8_t> &data, bool of_link) {
    drivelink_estimate estimate;
    drivelink_external external;
    return of_link ? drivelink_decode_external(data.data(), data.size(), &external)
                   : drivelink_decode_estimate(data.data(), data.size(), &estimate);
}

// Everything in the file is to be refused; what was not is counted in wrong.
int refuse(const std::string &path, bool of_link, int &wrong) {
    std::ifstream file(path);
    int vectors = 0;
    for (std::string name, payload; file >> name >> payload; vectors++) {
        if (taken(bytes(payload == "-" ? "" : payload), of_link)) {
            std::cerr << name << ": not refused\n";
            wrong++;
        }
    }
    return vectors;
}

// Everything in the file is to be decoded to its numbers; what was not is counted in wrong.
template <typename Check>
int decode(const std::string &path, Check check, int &wrong) {
    std::ifstream file(path);
    int vectors = 0;
    for (std::string line; std::getline(file, line); vectors++) {
        std::istringstream words(line);
        std::string name, payload;
        words >> name >> payload;
        const std::vector<std::string> numbers{std::istream_iterator<std::string>(words), {}};
        if (!check(bytes(payload), numbers)) {
            std::cerr << name << ": decoded wrongly\n";
            wrong++;
        }
    }
    return vectors;
}

}  // namespace

int main(int argc, char **argv) {
    const std::string folder = argc > 1 ? argv[1] : "../../tests/golden";
    int wrong = 0;
    const int vectors =
        decode(folder + "/estimate.txt", check, wrong) + decode(folder + "/external.txt", check_external, wrong);
    const int refused =
        refuse(folder + "/refused.txt", false, wrong) + refuse(folder + "/refused_external.txt", true, wrong);
    std::cout << vectors << " vectors, " << refused << " to be refused, " << wrong << " wrong\n";
    return vectors == 0 || refused == 0 || wrong != 0;
}
