//! The golden byte vectors that every language reads: `tests/golden` of the repository.

use drivelink_wire::{Estimate, External};
use zenoh::bytes::ZBytes;

fn bytes(hexadecimal: &str) -> Vec<u8> {
    (0..hexadecimal.len())
        .step_by(2)
        .map(|i| u8::from_str_radix(&hexadecimal[i..i + 2], 16).unwrap())
        .collect()
}

/// Equal bit by bit, every NaN being the same.
fn same(a: f64, text: &str) -> bool {
    let b: f64 = text.parse().unwrap();
    a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan())
}

#[test]
fn golden_vectors_decode_to_their_numbers() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/estimate.txt");
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.lines().count() >= 6);
    for line in text.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let (name, numbers) = (words[0], &words[2..]);
        let estimate = Estimate::decode(&ZBytes::from(bytes(words[1]))).unwrap();
        assert_eq!(estimate.sequence, numbers[0].parse::<u64>().unwrap(), "{name}");
        assert_eq!(estimate.stamp_ns, numbers[1].parse::<u64>().unwrap(), "{name}");
        assert_eq!(estimate.status, numbers[2].parse::<u32>().unwrap(), "{name}");
        assert_eq!(estimate.usable(), estimate.status & 0x1d51 == 1, "{name}");
        assert!(same(estimate.flexibility_torque_nm, numbers[3]), "{name}");
        assert!(same(estimate.stiffness_nm_rad, numbers[4]), "{name}");
        assert!(same(estimate.stiffness_std_nm_rad, numbers[5]), "{name}");
        assert_eq!(estimate.transmissions.len(), numbers[6].parse::<usize>().unwrap(), "{name}");
        for (transmission, group) in estimate.transmissions.iter().zip(numbers[7..].chunks(4)) {
            assert!(same(transmission.flexibility_torque_nm, group[0]), "{name}");
            assert!(same(transmission.stiffness_nm_rad, group[1]), "{name}");
            assert!(same(transmission.stiffness_std_nm_rad, group[2]), "{name}");
            assert!(same(transmission.deflection_rad, group[3]), "{name}");
        }
    }
}

/// Among them a length of 2^63 transmissions in 53 bytes: decoding must not allocate by it.
#[test]
fn what_is_no_estimate_or_cannot_be_valid_is_refused() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/refused.txt");
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.lines().count() >= 20);
    for line in text.lines() {
        let (name, payload) = line.split_once(' ').unwrap();
        let payload = if payload == "-" { vec![] } else { bytes(payload) };
        assert!(Estimate::decode(&ZBytes::from(payload)).is_err(), "{name}");
    }
}

#[test]
fn external_torques_decode_to_their_numbers_or_are_refused() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden");
    let text = std::fs::read_to_string(format!("{folder}/external.txt")).unwrap();
    assert!(text.lines().count() >= 5);
    for line in text.lines() {
        let words: Vec<&str> = line.split(' ').collect();
        let (name, numbers) = (words[0], &words[2..]);
        let external = External::decode(&ZBytes::from(bytes(words[1]))).unwrap();
        assert_eq!(external.sequence, numbers[0].parse::<u64>().unwrap(), "{name}");
        assert_eq!(external.stamp_ns, numbers[1].parse::<u64>().unwrap(), "{name}");
        assert_eq!(external.status, numbers[2].parse::<u32>().unwrap(), "{name}");
        assert!(same(external.external_torque_nm, numbers[3]), "{name}");
        assert!(same(external.external_torque_std_nm, numbers[4]), "{name}");
    }
    let text = std::fs::read_to_string(format!("{folder}/refused_external.txt")).unwrap();
    assert!(text.lines().count() >= 10);
    for line in text.lines() {
        let (name, payload) = line.split_once(' ').unwrap();
        let payload = if payload == "-" { vec![] } else { bytes(payload) };
        assert!(External::decode(&ZBytes::from(payload)).is_err(), "{name}");
    }
}
