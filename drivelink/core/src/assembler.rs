//! Frames in, one sample per SYNC out (CiA 301, 7.2.2 and 7.2.5).
//!
//! Frames after SYNC k and before SYNC k+1 belong to sample k. A sample is complete with its last frame. A
//! missing frame leaves a gap, counted by node, never filled with an older value. The frame after a missing
//! one may be the missing one, late: for a while such cycles are flagged and decided only at their end, when
//! a second frame shows that the first was late.
//!
//! No clock is read here: the same frames in the same order give the same samples, live or from a log. The
//! caller, who has the stamps, gives the number of periods since the last SYNC.

use estimator_core::sample::{MOTORS, Sample};

use crate::cross_check::{CrossCheck, Kind, spoils};
use crate::frames::{TpdoDecoder, target};
use crate::layout::{self, Signal};
use crate::node::Node;
use crate::status::{BUS_FAULT, CONTRADICTED, DRIVE_FAULT, NODE_RESTARTED, UNTIMED};

/// Identifier of SYNC.
pub const SYNC_COB_ID: u32 = 0x080;
/// Identifiers of CAN base frames.
const COB_IDS: usize = 0x800;
/// The jump of a SYNC that was counted as lost before it came.
pub const LATE: i64 = -1;
/// Cycles for which two different frames in one cycle discredit their sender.
const CONFLICT_CYCLES: u32 = 20;
/// Frames that may come late in one go, after a stall of somebody.
const MOST_OWED: u32 = 10;
/// Cycles after a missing frame or a SYNC too many in which what comes may be one period late.
const DOUBT_CYCLES: u32 = 100;

/// Values of a joint, at most, see [`target`].
const VALUES: usize = 8 * MOTORS + 2;

/// Who wants the frames of an identifier.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Receiver {
    Nobody,
    TpdoDecoder(usize),
    Sync,
    Command,
    Heartbeat(usize),
    Error(usize),
    Request(usize),
}

/// Makes the samples of one joint from the frames of its nodes.
#[derive(Clone, Debug)]
pub struct Assembler {
    motors: usize,
    active: bool,
    hold_periods: i64,
    values: [f64; VALUES],
    answered: [i64; VALUES], // number of the SYNC that each value answered
    period: f64,             // s
    checks: Vec<CrossCheck>,
    nodes: Vec<Node>,
    decoders: Vec<TpdoDecoder>,
    receivers: Vec<Receiver>,
    open: bool,
    spoiled: bool,
    cycle_fault: bool,
    restart: bool,
    unnumbered: bool,
    faulted: u32,
    contradicted: u32, // by a cross-check
    misread: u32,      // by what a node says of itself
    untimed: u32,      // cycles for which SYNCs of another master discredit the samples
    awaited: usize,
    /// Number of the current SYNC, from 0; -1 before the first.
    pub sequence: i64,
    /// Number of the cycle the last SYNC closed without a sample, if it had none.
    pub missed: Option<i64>,
    /// Service bits of the status that hold for the sample just given, or the cycle just missed.
    pub flags: u32,
}

impl Assembler {
    /// The assembler of a joint with so many motors.
    ///
    /// `active`: whether we configure the nodes. Then a node that rebooted is believed again when it is started again;
    /// else `trust` alone makes it so. `hold_periods`: how long the last value of a TPDO that is not
    /// sent on SYNC may be used while nothing at all is heard of its node; and how long one that is sent on SYNC may
    /// fail before its node may have started anew unheard: positions may count from elsewhere then, and a node that we
    /// configure is not believed any more.
    /// `period_s`: communication cycle.
    ///
    /// # Errors
    /// Two frames with one identifier, or a motor without position or torque.
    pub fn new(
        layouts: &[layout::Node],
        motors: usize,
        active: bool,
        hold_periods: i64,
        period_s: f64,
    ) -> Result<Assembler, String> {
        if motors > MOTORS {
            return Err(format!("expected at most {MOTORS} motors, got {motors}"));
        }
        let mut assembler = Assembler {
            motors,
            active,
            hold_periods,
            values: [f64::NAN; VALUES],
            answered: [-1; VALUES],
            period: period_s,
            checks: Vec::new(),
            nodes: Vec::new(),
            decoders: Vec::new(),
            receivers: Vec::new(),
            open: false,
            spoiled: false,
            cycle_fault: false,
            restart: false,
            unnumbered: false,
            faulted: 0,
            contradicted: 0,
            misread: 0,
            untimed: 0,
            awaited: 0,
            sequence: -1,
            missed: None,
            flags: 0,
        };
        for layout in layouts {
            if !assembler.nodes.iter().any(|node| node.node_id == layout.node_id) {
                assembler.nodes.push(Node::new(layout.node_id, active));
            }
            assembler.add(layout)?;
        }
        assembler.check()?;
        assembler.arrange();
        assembler.arrange_checks();
        Ok(assembler)
    }

    /// How many motors the joint has.
    #[must_use]
    pub fn motors(&self) -> usize {
        self.motors
    }

    /// Identifiers that concern this joint, SYNC aside.
    pub fn cob_ids(&self) -> impl Iterator<Item = u32> + '_ {
        (0u32..).zip(&self.receivers).filter_map(|(cob_id, receiver)| {
            (*receiver != Receiver::Nobody && *receiver != Receiver::Sync).then_some(cob_id)
        })
    }

    /// The joint's nodes.
    #[must_use]
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// The checks that its mapping makes possible.
    #[must_use]
    pub fn checks(&self) -> &[CrossCheck] {
        &self.checks
    }

    /// Whether any frame carries the link position.
    #[must_use]
    pub fn has_link(&self) -> bool {
        self.carries(3 * self.motors)
    }

    /// Whether this cycle has given its sample: nothing more is expected before the next SYNC.
    #[must_use]
    pub fn complete(&self) -> bool {
        !self.open
    }

    /// Take one frame in the order of the bus, SYNC included; the sample that it completes, if it does.
    ///
    /// `jump`: for a SYNC, whole periods since the one before; 0: one that was not due; [`LATE`]: one whose period is
    /// over.
    pub fn feed(&mut self, cob_id: u32, data: &[u8], jump: i64) -> Option<Sample> {
        match self.receivers.get(cob_id as usize)? {
            Receiver::Nobody => None,
            Receiver::TpdoDecoder(decoder) => self.pdo(*decoder, data),
            Receiver::Sync => self.sync(jump),
            Receiver::Command => {
                if let [command, addressed] = *data {
                    for node in 0..self.nodes.len() {
                        if addressed == 0 || u32::from(addressed) == self.nodes[node].node_id {
                            let (node, decoders) = self.node_and_decoders(node);
                            node.command(command, addressed, decoders);
                        }
                    }
                }
                self.note_news();
                None
            }
            Receiver::Heartbeat(node) => {
                if let [state] = *data {
                    let (node, decoders) = self.node_and_decoders(*node);
                    node.heartbeat(state, decoders);
                }
                self.note_news();
                None
            }
            Receiver::Request(node) => {
                self.nodes[*node].request(data);
                self.note_news();
                None
            }
            Receiver::Error(node) => {
                if let [low, high, _, _, _, _, _, _] = *data {
                    self.nodes[*node].error(u16::from_le_bytes([low, high]));
                }
                self.note_news();
                None
            }
        }
    }

    /// A SYNC: close the cycle and open the next one; the sample if it was only now certain.
    pub fn sync(&mut self, jump: i64) -> Option<Sample> {
        if jump == LATE {
            return self.open_unnumbered();
        }
        if jump <= 0 {
            self.spoiled = true; // what comes now answers that SYNC or ours: unknowable
            self.untimed = DOUBT_CYCLES;
            for decoder in self.decoders.iter_mut().filter(|decoder| decoder.timed()) {
                decoder.suspect = DOUBT_CYCLES; // nor of those that come after ours
            }
            return None;
        }
        self.cross_check();
        let sample = self.close(jump);
        self.untimed = self.untimed.saturating_sub(1);
        self.sequence += jump;
        self.open = true;
        self.spoiled = false;
        self.cycle_fault = false;
        self.await_all();
        sample
    }

    /// Our own master's SYNC, too late for a number: what answers it is of no sample, and spoils none.
    fn open_unnumbered(&mut self) -> Option<Sample> {
        let sample = self.close(0);
        self.await_all();
        self.unnumbered = true;
        sample
    }

    fn await_all(&mut self) {
        self.awaited = 0;
        for decoder in &mut self.decoders {
            decoder.arrived = false;
            self.awaited += usize::from(decoder.timed());
        }
    }

    fn close(&mut self, jump: i64) -> Option<Sample> {
        let was_open = std::mem::replace(&mut self.open, false);
        let unnumbered = std::mem::replace(&mut self.unnumbered, false);
        self.missed = None;
        for decoder in self.decoders.iter_mut().filter(|decoder| decoder.needed() && !decoder.arrived) {
            decoder.silent += jump;
            if decoder.every > 0 && decoder.silent > self.hold_periods {
                // Nobody knows what it has lived through: its boot-up message may have got lost with its frames.
                self.restart |= decoder.heard && decoder.silent - jump <= self.hold_periods;
                self.nodes[decoder.node].trusted &= !self.active;
            }
        }
        if !was_open {
            if unnumbered {
                self.note_missing();
            }
            return None;
        }
        if self.usable() {
            for decoder in self.decoders.iter_mut().filter(|decoder| decoder.timed() && decoder.suspect > 0) {
                decoder.suspect -= 1;
                decoder.owed = if decoder.suspect > 0 { decoder.owed } else { 0 };
                self.cycle_fault = true;
            }
            return Some(self.sample());
        }
        let all_arrived = self.decoders.iter().all(|decoder| decoder.arrived || !decoder.timed());
        if self.note_missing() || self.spoiled || all_arrived {
            self.missed = Some(self.sequence);
            self.flags = BUS_FAULT | self.faulted | self.contradicted | self.misread;
        }
        None
    }

    /// Count what has not come though it was due; whether there is any.
    fn note_missing(&mut self) -> bool {
        let mut missing = false;
        for decoder in self.decoders.iter_mut().filter(|decoder| decoder.timed()) {
            if !decoder.arrived && decoder.silent >= decoder.every {
                self.nodes[decoder.node].counters.missing += 1;
                decoder.suspect = DOUBT_CYCLES;
                decoder.owed = (decoder.owed + 1).min(MOST_OWED);
                missing = true;
            } else if self.spoiled {
                decoder.suspect = DOUBT_CYCLES;
            }
        }
        missing
    }

    /// Whether everything a sample needs is there, and nothing speaks against it.
    fn usable(&self) -> bool {
        !self.spoiled
            && self.decoders.iter().all(|decoder| {
                if decoder.timed() {
                    decoder.arrived && decoder.conflict == 0
                } else {
                    !decoder.held()
                        || decoder.heard
                            && decoder.silent <= self.hold_periods
                            && self.nodes[decoder.node].trusted
                }
            })
    }

    /// Whether no frame of this cycle can be that of an earlier one.
    fn certain(&self) -> bool {
        !self.decoders.iter().any(|decoder| decoder.timed() && decoder.suspect > 0)
    }

    fn pdo(&mut self, index: usize, data: &[u8]) -> Option<Sample> {
        let decoder = &self.decoders[index];
        let (every, needed) = (decoder.every, decoder.needed());
        let node = &mut self.nodes[decoder.node];
        if !decoder.fits(data.len()) {
            node.counters.wrong_length += 1;
            self.cycle_fault = true;
            return None;
        }
        if !node.trusted {
            node.counters.ignored += 1;
            return None;
        }
        if self.sequence < 0 {
            return None;
        }
        if decoder.arrived && every > 0 {
            if !self.repeated(index, data) {
                return None;
            }
        } else {
            let decoder = &mut self.decoders[index];
            decoder.conflict = decoder.conflict.saturating_sub(1);
        }
        self.decode(index, data);
        let decoder = &mut self.decoders[index];
        if !decoder.arrived && every > 0 && needed {
            self.awaited = self.awaited.saturating_sub(1);
        }
        decoder.arrived = true;
        decoder.heard = true;
        decoder.silent = 0;
        self.nodes[decoder.node].counters.received += 1;
        if self.awaited > 0 || !self.open || !needed {
            return None;
        }
        let any_timed = self.decoders.iter().any(TpdoDecoder::timed);
        (any_timed && self.usable() && self.certain()).then(|| self.sample())
    }

    /// Whether a further frame in one cycle is the one that belongs to it.
    fn repeated(&mut self, index: usize, data: &[u8]) -> bool {
        let decoder = &mut self.decoders[index];
        let counters = &mut self.nodes[decoder.node].counters;
        let same = decoder.repeats(data);
        if decoder.suspect > 0 && same {
            counters.duplicate += 1; // the same once more settles nothing
            return false;
        }
        if decoder.suspect > 0 && decoder.conflict == 0 {
            // The first was a late one of a cycle before.
            decoder.owed = decoder.owed.saturating_sub(1);
            if decoder.owed == 0 {
                decoder.suspect = 0;
            }
            counters.late += 1;
            self.cycle_fault = true;
            return true;
        }
        counters.duplicate += 1;
        if !same && !self.spoiled {
            decoder.conflict = CONFLICT_CYCLES; // two nodes answer, or somebody babbles: believe neither
            self.spoiled = true;
            self.restart = true; // the one that is left may count from elsewhere
            counters.conflicting += 1;
        }
        false
    }

    fn decode(&mut self, index: usize, data: &[u8]) {
        let decoder = &mut self.decoders[index];
        let statusword = decoder.store(data);
        for field in &mut decoder.fields {
            self.values[field.target] = field.take(data);
            self.answered[field.target] = self.sequence;
        }
        let node = &mut self.nodes[decoder.node];
        if statusword.is_some() && statusword != node.statusword {
            node.take_statusword(statusword.unwrap_or_default());
            self.note_news();
        }
    }

    fn sample(&mut self) -> Sample {
        self.open = false;
        let mut flags = self.faulted | self.contradicted | self.misread;
        if self.cycle_fault {
            flags |= BUS_FAULT;
        }
        if self.untimed > 0 {
            flags |= UNTIMED;
        }
        if std::mem::replace(&mut self.restart, self.nodes.iter().any(|node| node.searching)) {
            flags |= NODE_RESTARTED;
            self.checks.iter_mut().for_each(CrossCheck::reset);
            self.contradicted = 0;
        }
        self.flags = flags;
        let m = self.motors;
        let of_motors = |first: usize| {
            std::array::from_fn(|motor| if motor < m { self.values[first + motor] } else { f64::NAN })
        };
        Sample {
            sequence: self.sequence as u64,
            motor_position: of_motors(0),
            motor_velocity: of_motors(m),
            motor_torque: of_motors(2 * m),
            link_position: self.values[3 * m],
            link_velocity: self.values[3 * m + 1],
            external_torque: f64::NAN,
        }
    }

    /// From now on `trust` alone makes a node believed again: somebody else may start it too.
    pub fn supervise(&mut self) {
        for node in &mut self.nodes {
            node.supervised = true;
        }
    }

    /// Do not use what a node sends until it is started again.
    pub fn distrust(&mut self, node_id: u32) {
        for node in self.nodes.iter_mut().filter(|node| node.node_id == node_id) {
            node.trusted = false;
        }
    }

    /// A node says by SDO what its frames do not, or does no longer.
    pub fn contradict(&mut self, node_id: u32, contradicted: bool) {
        for node in self.nodes.iter_mut().filter(|node| node.node_id == node_id) {
            node.contradicted = contradicted;
        }
        let any = self.nodes.iter().any(|node| node.contradicted);
        self.misread = if any { CONTRADICTED } else { 0 };
    }

    /// A node has been configured and started.
    pub fn trust(&mut self, node_id: u32) {
        if let Some(node) = self.nodes.iter().position(|node| node.node_id == node_id) {
            let (node, decoders) = self.node_and_decoders(node);
            node.trust(decoders);
        }
    }

    /// A node has been configured differently: from now on its frames are read by this layout.
    ///
    /// # Errors
    /// As for `new`; then everything is as it was.
    pub fn relayout(&mut self, layout: &layout::Node) -> Result<(), String> {
        let before = self.decoders.clone();
        self.decoders.retain(|decoder| self.nodes[decoder.node].node_id != layout.node_id);
        let changed = self.add(layout).and_then(|()| self.check());
        match changed {
            Ok(()) => self.restart = true, // what is decoded anew may jump
            Err(_) => self.decoders = before,
        }
        self.arrange();
        self.arrange_checks();
        changed
    }

    fn add(&mut self, layout: &layout::Node) -> Result<(), String> {
        let node_id = layout.node_id;
        let Some(node) = self.nodes.iter().position(|node| node.node_id == node_id) else {
            return Err(format!("node {node_id}: expected a node of this joint"));
        };
        for tpdo in &layout.tpdos {
            if self.decoders.iter().any(|decoder| decoder.cob_id == tpdo.cob_id) {
                return Err(format!("node {node_id}: COB-ID 0x{:03X} is used by two TPDOs", tpdo.cob_id));
            }
            self.decoders.push(TpdoDecoder::new(tpdo, node, layout.motor, self.motors));
        }
        Ok(())
    }

    fn check(&self) -> Result<(), String> {
        for motor in 0..self.motors {
            for (target, what) in [(motor, "position"), (2 * self.motors + motor, "torque")] {
                if !self.carries(target) {
                    return Err(format!("motor {}: no TPDO carries its {what}", motor + 1));
                }
            }
        }
        Ok(())
    }

    fn carries(&self, target: usize) -> bool {
        self.decoders.iter().flat_map(|decoder| &decoder.fields).any(|field| field.target == target)
    }

    fn arrange(&mut self) {
        self.receivers.clear();
        self.receivers.resize(COB_IDS, Receiver::Nobody);
        self.receivers[0] = Receiver::Command;
        for (node, of) in self.nodes.iter().enumerate() {
            self.receivers[(0x700 + of.node_id as usize) % COB_IDS] = Receiver::Heartbeat(node);
            self.receivers[(0x080 + of.node_id as usize) % COB_IDS] = Receiver::Error(node);
            self.receivers[(0x600 + of.node_id as usize) % COB_IDS] = Receiver::Request(node);
        }
        self.receivers[SYNC_COB_ID as usize] = Receiver::Sync;
        for (decoder, of) in self.decoders.iter().enumerate() {
            self.receivers[of.cob_id as usize % COB_IDS] = Receiver::TpdoDecoder(decoder);
        }
        self.awaited = self.decoders.iter().filter(|decoder| decoder.timed() && !decoder.arrived).count();
    }

    /// Which readings of one quantity are mapped.
    fn arrange_checks(&mut self) {
        let fields: Vec<(usize, f64)> = self
            .decoders
            .iter()
            .flat_map(|decoder| &decoder.fields)
            .map(|field| (field.target, field.scale))
            .collect();
        self.checks.clear();
        self.contradicted = 0;
        for motor in 0..self.motors {
            let step = |signal| {
                let place = target(signal, Some(motor), self.motors);
                fields.iter().find(|(target, _)| Some(*target) == place).map(|(_, scale)| *scale)
            };
            let (position, torque) = (step(Signal::MotorPosition), step(Signal::MotorTorque));
            let velocity = step(Signal::MotorVelocity).or(step(Signal::VelocityCheck));
            let demand = step(Signal::PositionDemand).and(position);
            for (kind, first, second) in [
                (Kind::Velocity, position, velocity),
                (Kind::Current, torque, step(Signal::TorqueCheck)),
                (Kind::SecondEncoder, position, step(Signal::SecondPosition)),
                (Kind::FollowingError, demand, step(Signal::FollowingError)),
            ] {
                if let (Some(first), Some(second)) = (first, second) {
                    self.checks.push(CrossCheck::new(kind, motor, (first, second), self.period));
                }
            }
        }
    }

    /// Hold the readings of the cycle that ends against each other, where all of them are of it.
    fn cross_check(&mut self) {
        if self.checks.is_empty() || self.open || self.spoiled || self.untimed > 0 || self.sequence < 0 {
            return;
        }
        let (motors, mut ended) = (self.motors, false);
        for check in &mut self.checks {
            let motor = check.motor;
            let now = |signal| {
                let place = target(signal, Some(motor), motors)?;
                (self.answered[place] == self.sequence).then_some(self.values[place])
            };
            let position = now(Signal::MotorPosition);
            let (first, second) = match check.kind {
                Kind::Velocity => (position, now(Signal::MotorVelocity).or(now(Signal::VelocityCheck))),
                Kind::Current => (now(Signal::MotorTorque), now(Signal::TorqueCheck)),
                Kind::SecondEncoder => (position, now(Signal::SecondPosition)),
                Kind::FollowingError => {
                    let demand = now(Signal::PositionDemand);
                    (demand.zip(position).map(|(demand, is)| demand - is), now(Signal::FollowingError))
                }
            };
            if let (Some(first), Some(second)) = (first, second) {
                ended |= check.take(self.sequence, first, second);
            }
        }
        if ended {
            let spoilt = (0..motors).any(|motor| spoils(&self.checks, motor));
            self.contradicted = if spoilt { CONTRADICTED } else { 0 };
        }
    }

    fn node_and_decoders(&mut self, node: usize) -> (&mut Node, impl Iterator<Item = &mut TpdoDecoder>) {
        (&mut self.nodes[node], self.decoders.iter_mut().filter(move |decoder| decoder.node == node))
    }

    fn note_news(&mut self) {
        self.faulted = 0;
        for node in &mut self.nodes {
            if node.faulted || node.emergency != 0 {
                self.faulted = DRIVE_FAULT;
            }
            self.restart |= std::mem::replace(&mut node.restarted, false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layout::{MappedObject, Node as Layout, Tpdo};

    fn object(signal: Signal, bits: u32, scale: f64) -> MappedObject {
        MappedObject { signal, bits, signed: true, scale, offset: 0.0, range: 0 }
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
}
