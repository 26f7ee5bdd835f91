use super::*;
use crate::layout::{MappedObject, Node as Layout, Signal, Tpdo};

fn object(signal: Signal, bits: u32, scale: f64) -> MappedObject {
    MappedObject { signal, bits, signed: true, scale, offset: 0.0, wraps: false, modulus: 0 }
}

/// A drive with position and torque at 0x181, an encoder at 0x183.
fn assembler() -> Assembler {
    let tpdo = |cob_id, objects| Tpdo { cob_id, objects, transmission_type: 1 };
    let drive = [object(Signal::MotorPosition, 32, 1e-3), object(Signal::MotorTorque, 16, 0.1)];
    let link = [object(Signal::LinkPosition, 32, 1e-3)];
    let layouts = [
        Layout { node_id: 1, motor: Some(0), tpdos: vec![tpdo(0x181, drive.to_vec())] },
        Layout { node_id: 3, motor: None, tpdos: vec![tpdo(0x183, link.to_vec())] },
    ];
    Assembler::new(&layouts, 1, true, 250, 1e-3).unwrap()
}

fn drive(position: i32, torque: i16) -> Vec<u8> {
    [&position.to_le_bytes()[..], &torque.to_le_bytes()[..]].concat()
}

#[test]
fn a_sample_is_given_with_the_last_frame_of_its_sync() {
    let mut made = assembler();
    assert_eq!(made.cob_ids().filter(|id| [0x181, 0x183].contains(id)).count(), 2);
    assert!(made.has_link() && made.feed(SYNC_COB_ID, &[], 1).is_none());
    assert!(made.feed(0x181, &drive(-1500, 20), 0).is_none());
    let sample = made.feed(0x183, &250i32.to_le_bytes(), 0).unwrap();
    assert_eq!((sample.sequence, sample.motor_position[0], sample.link_position), (0, -1.5, 0.25));
    assert!((sample.motor_torque[0] - 2.0).abs() < 1e-12 && made.complete() && made.flags == 0);
}

#[test]
fn a_frame_that_does_not_come_is_a_gap_of_its_node() {
    let mut made = assembler();
    made.feed(SYNC_COB_ID, &[], 1);
    made.feed(0x181, &drive(0, 0), 0);
    assert!(made.feed(SYNC_COB_ID, &[], 1).is_none());
    assert_eq!((made.missed, made.flags), (Some(0), BUS_FAULT));
    assert_eq!(made.nodes().iter().map(|node| node.counters.missing).collect::<Vec<_>>(), [0, 1]);
}

#[test]
fn a_frame_of_another_length_and_frames_of_a_rebooted_node_are_not_used() {
    let mut made = assembler();
    made.feed(SYNC_COB_ID, &[], 1);
    made.feed(0x181, &[1, 2, 3], 0);
    assert_eq!(made.nodes()[0].counters.wrong_length, 1);
    made.feed(0x701, &[0], 0);
    made.feed(SYNC_COB_ID, &[], 1);
    made.feed(0x181, &drive(0, 0), 0);
    assert_eq!((made.nodes()[0].counters.reboots, made.nodes()[0].counters.ignored), (1, 1));
}

#[test]
fn a_joint_lacks_no_position_and_no_frame_has_two_senders() {
    assert!(Assembler::new(&[], 1, true, 250, 1e-3).is_err());
    let tpdo = Tpdo { cob_id: 0x181, objects: vec![], transmission_type: 1 };
    let twice = Layout { node_id: 1, motor: None, tpdos: vec![tpdo.clone(), tpdo] };
    assert!(Assembler::new(&[twice], 0, true, 250, 1e-3).is_err());
}

#[test]
fn a_sample_after_a_missing_frame_may_be_a_period_late_and_so_may_that_of_the_cycle_in_which_it_came() {
    let mut made = assembler();
    made.feed(SYNC_COB_ID, &[], 1);
    made.feed(0x181, &drive(0, 0), 0);
    made.feed(SYNC_COB_ID, &[], 1);
    made.feed(0x183, &1i32.to_le_bytes(), 0);
    assert!(made.feed(0x181, &drive(1, 0), 0).is_none());
    assert_eq!((made.feed(SYNC_COB_ID, &[], 1).unwrap().sequence, made.late_s), (1, 1e-3));
    made.feed(0x183, &1i32.to_le_bytes(), 0);
    made.feed(0x183, &2i32.to_le_bytes(), 0);
    assert!(made.feed(0x181, &drive(2, 0), 0).is_none()); // the second may be somebody else's, and come again
    assert_eq!((made.feed(SYNC_COB_ID, &[], 1).unwrap().sequence, made.late_s), (2, 1e-3));
    made.feed(0x183, &3i32.to_le_bytes(), 0);
    assert_eq!((made.feed(0x181, &drive(3, 0), 0).unwrap().sequence, made.late_s), (3, 0.0));
}
