//! Frames in, one sample per SYNC out (CiA 301, 7.2.2 and 7.2.5).
//!
//! Frames after SYNC k and before SYNC k+1 belong to sample k. A sample is complete with its last frame. A
//! missing frame leaves a gap, counted by node, never filled with an older value. The frame after a missing
//! one may be the missing one, late: for a while such cycles are flagged and decided only at their end, when
//! a second frame shows that the first was late.
//!
//! No clock is read here: the same frames in the same order give the same samples, live or from a log. The
//! caller, who has the stamps, gives the number of periods since the last SYNC.

mod arrange;
mod compare;
#[cfg(test)]
mod tests;

use estimator_core::sample::{MOTORS, Sample};

use crate::cross_check::CrossCheck;
use crate::frames::TpdoDecoder;
use crate::node::Node;
use status::{BUS_FAULT, NODE_RESTARTED, UNTIMED};

/// Bits of an estimate's status that the service adds.
pub mod status {
    estimator_core::status_bits! {
        DRIVE_FAULT = 8, BUS_FAULT = 9, STALE = 10, UNTIMED = 11, NODE_RESTARTED = 12, CONTRADICTED = 14,
    }
}

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

/// Values of a joint, at most, see [`crate::frames::target`].
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
    /// By how much the sample just given may be of an earlier moment, s.
    pub late_s: f64,
}

impl Assembler {
    /// How many motors the joint has.
    #[must_use]
    pub fn motors(&self) -> usize {
        self.motors
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
            decoder.replaced = false;
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
            let late_s = if self.certain() { 0.0 } else { self.period };
            for decoder in self.decoders.iter_mut().filter(|decoder| decoder.timed() && decoder.suspect > 0) {
                decoder.suspect -= 1;
                decoder.owed = if decoder.suspect > 0 { decoder.owed } else { 0 };
                self.cycle_fault = true;
            }
            let sample = self.sample();
            self.late_s = late_s;
            return Some(sample);
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

    /// Whether no frame of this cycle can be that of an earlier one, or an answer to a SYNC that came late: where a frame
    /// has come late, the one after it may be such an answer.
    fn certain(&self) -> bool {
        !self.decoders.iter().any(|decoder| decoder.replaced || decoder.timed() && decoder.suspect > 0)
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
        // One that repeats itself in what is left of the cycle was no late one's successor.
        (any_timed && self.usable() && self.certain()).then(|| self.sample())
    }

    /// Whether a further frame in one cycle is the one that belongs to it.
    fn repeated(&mut self, index: usize, data: &[u8]) -> bool {
        let decoder = &mut self.decoders[index];
        let counters = &mut self.nodes[decoder.node].counters;
        let same = decoder.repeats(data);
        if same && decoder.replaced {
            decoder.conflict = CONFLICT_CYCLES; // somebody may repeat himself after the one that belongs to it
            self.spoiled = true;
        }
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
            decoder.replaced = true;
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
            self.values[field.target] = field.decode(data);
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
        self.late_s = 0.0;
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
}
