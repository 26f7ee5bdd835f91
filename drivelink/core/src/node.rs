//! The state of a node from its other messages: NMT commands, boot-up, heartbeat, EMCY (CiA 301, 7.2.8).
//!
//! Derived from frames alone, so that a replayed log gives the same states as the live run.

use crate::frames::TpdoDecoder;

const START: u8 = 0x01;
const RESETS: [u8; 2] = [0x81, 0x82]; // node, communication
const FAULT_BIT: i64 = 0x0008; // of the statusword
const MODE: u16 = 0x6060; // mode of operation (CiA 402-2, 8.5.3)
const HOMING: u8 = 6;
const ATTAINED: i64 = 0x1000; // bits of the statusword in that mode: homing attained …
const FAILED: i64 = 0x2000; // … and homing error
const HOME: [u16; 3] = [0x607C, 0x6098, 0x6003]; // home offset, homing method (CiA 402-2, 11.4); preset (CiA 406)

/// What became of one node's frames since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "python",
    pyo3::pyclass(frozen, get_all, module = "drivelink._core", name = "NodeCounters")
)]
pub struct Counters {
    /// PDOs of this node that were used.
    pub received: u64,
    /// Frames that had not come when the next SYNC came.
    pub missing: u64,
    /// Of these, frames that came in the cycle after.
    pub late: u64,
    /// Frames beyond the one a cycle needs.
    pub duplicate: u64,
    /// Of the cycles with such frames, those in which they differed; not used.
    pub conflicting: u64,
    /// Frames that do not carry what is mapped; not used.
    pub wrong_length: u64,
    /// Frames sent after a reboot, before the node was configured and started again.
    pub ignored: u64,
    /// Boot-up messages.
    pub reboots: u64,
    /// EMCY messages that report an error.
    pub emergencies: u64,
}

/// One node's standing: whether its frames are believed, and whether it reports a fault.
///
/// A node that was reset may send its default PDOs, which look like ours and mean something else: it is not believed
/// before it has been started again.
#[derive(Clone, Debug)]
pub struct Node {
    /// 1 to 127.
    pub node_id: u32,
    /// Whether we configure the nodes. We start each by its own number when it is configured; a start of all nodes is
    /// somebody else's, and says nothing of their mapping. In a log, a start by its own number is taken for ours.
    /// Where somebody else configures them no start proves anything: see `drivelink.cycle.following`.
    active: bool,
    /// Somebody knows for sure when it is configured, and calls `trust`: no frame shows it.
    pub supervised: bool,
    /// What became of its frames.
    pub counters: Counters,
    /// Whether its PDOs are used.
    pub trusted: bool,
    /// Its frames carry something else than their maps say; for who reads its objects by SDO to know.
    pub contradicted: bool,
    /// As last heard.
    pub statusword: Option<i64>,
    /// The fault bit of it.
    pub faulted: bool,
    /// Code of the last EMCY, 0 after its reset.
    pub emergency: u16,
    /// Its position counters may have started anew; for whoever reads it to clear.
    pub restarted: bool,
    /// Its mode of operation is homing, as last written, and no end of the homing has been seen.
    homing: bool,
    /// By its statusword the homing has not ended: its positions may be set anew with every sample.
    pub searching: bool,
}

impl Node {
    /// A node that is believed.
    pub fn new(node_id: u32, active: bool) -> Node {
        Node {
            node_id,
            active,
            supervised: false,
            counters: Counters::default(),
            trusted: true,
            contradicted: false,
            statusword: None,
            faulted: false,
            emergency: 0,
            restarted: false,
            homing: false,
            searching: false,
        }
    }

    /// From now on its frames mean what its layout says; `decoders` are its own.
    pub fn trust<'a>(&mut self, decoders: impl Iterator<Item = &'a mut TpdoDecoder>) {
        self.trusted = true;
        for decoder in decoders {
            decoder.silent = 0;
            decoder.owed = 0;
        }
    }

    /// An NMT command that is addressed to this node, or to all.
    pub fn command<'a>(
        &mut self,
        command: u8,
        addressed: u8,
        decoders: impl Iterator<Item = &'a mut TpdoDecoder>,
    ) {
        if command == START && self.active && !self.supervised && addressed != 0 {
            self.trust(decoders);
        } else if RESETS.contains(&command) {
            self.trusted = false;
            self.restarted = true; // it will; its boot-up message may get lost
        }
    }

    /// Boot-up (state 0) or heartbeat.
    pub fn heartbeat<'a>(&mut self, state: u8, decoders: impl Iterator<Item = &'a mut TpdoDecoder>) {
        let state = state & 0x7F;
        if state == 0 {
            self.counters.reboots += 1;
            self.trusted = false;
            self.faulted = false;
            self.emergency = 0;
            self.statusword = None;
            (self.homing, self.searching) = (false, false);
            self.restarted = true;
            decoders.for_each(TpdoDecoder::forget);
            return;
        }
        for decoder in decoders.filter(|decoder| decoder.every == 0) {
            decoder.silent = 0;
        }
    }

    /// A frame of an SDO client: a homing, another home offset or a preset moves the zero of its positions.
    pub fn request(&mut self, data: &[u8]) {
        // Initiate download, expedited or not, and block download.
        let [command, low, high, _, value, _, _, _] = *data else { return };
        if command >> 5 != 1 && command & 0xE1 != 0xC0 {
            return;
        }
        let index = u16::from_le_bytes([low, high]);
        let homing = index == MODE && value == HOMING;
        self.restarted |= HOME.contains(&index) || homing || (index == MODE && self.homing);
        if index == MODE {
            self.homing = homing;
            self.searching = homing && self.statusword.is_some_and(|word| word & ATTAINED == 0);
        }
    }

    /// EMCY: a fault, until it is reset with code 0 or the statusword leaves its fault state.
    pub fn error(&mut self, code: u16) {
        self.emergency = if code & 0xFF00 != 0 { code } else { 0 };
        self.counters.emergencies += u64::from(self.emergency != 0);
    }

    /// The statusword has changed (CiA 402-2, 8.4.2).
    pub fn take_statusword(&mut self, statusword: i64) {
        self.statusword = Some(statusword);
        let faulted = statusword & FAULT_BIT != 0;
        if self.faulted && !faulted {
            self.emergency = 0;
        }
        self.faulted = faulted;
        if self.homing {
            // It ends with the sample that is counted from home. A second one in the same mode begins as the first.
            let ended = self.searching && statusword & (ATTAINED | FAILED) == ATTAINED;
            self.restarted |= ended;
            self.searching = statusword & ATTAINED == 0 || self.searching && !ended;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nobody() -> impl Iterator<Item = &'static mut TpdoDecoder> {
        std::iter::empty()
    }

    #[test]
    fn a_node_that_booted_is_believed_when_it_is_started_by_its_own_number() {
        let mut node = Node::new(3, true);
        node.heartbeat(0, nobody());
        assert!(!node.trusted && node.restarted && node.counters.reboots == 1);
        node.command(START, 0, nobody()); // somebody else's start of all
        assert!(!node.trusted);
        node.command(START, 3, nobody());
        assert!(node.trusted);
        node.command(0x81, 0, nobody());
        assert!(!node.trusted);
        node.supervised = true;
        node.command(START, 3, nobody());
        assert!(!node.trusted);
    }

    #[test]
    fn a_heartbeat_is_no_boot_up() {
        let mut node = Node::new(3, true);
        node.heartbeat(0x85, nobody()); // operational, with a toggle bit as node guarding has it
        assert!(node.trusted && node.counters.reboots == 0);
    }

    #[test]
    fn an_error_lasts_until_its_reset_or_the_end_of_the_fault_state() {
        let mut node = Node::new(1, true);
        node.error(0x2310);
        assert_eq!((node.emergency, node.counters.emergencies), (0x2310, 1));
        node.error(0);
        assert_eq!((node.emergency, node.counters.emergencies), (0, 1));
        node.error(0x2310);
        node.take_statusword(0x0008);
        assert!(node.faulted && node.emergency == 0x2310);
        node.take_statusword(0x0027);
        assert!(!node.faulted && node.emergency == 0);
    }

    #[test]
    fn a_homing_and_another_home_offset_lose_the_zero() {
        for (sent, lost) in [
            ([0x2F, 0x60, 0x60, 0, HOMING, 0, 0, 0], true),
            ([0x2F, 0x60, 0x60, 0, 8, 0, 0, 0], false),
            ([0x23, 0x7C, 0x60, 0, 0x10, 0x27, 0, 0], true),
            ([0x2F, 0x98, 0x60, 0, 0x23, 0, 0, 0], true), // homing method
            ([0x23, 0x03, 0x60, 0, 0xE8, 3, 0, 0], true), // an encoder's preset
            ([0x21, 0x7C, 0x60, 0, 4, 0, 0, 0], true),    // by segments
            ([0xC6, 0x7C, 0x60, 0, 4, 0, 0, 0], true),    // by blocks
            ([0x40, 0x7C, 0x60, 0, 0, 0, 0, 0], false),   // an upload changes nothing
            ([0x80, 0x60, 0x60, 0, HOMING, 0, 0, 0], false),
            ([0x23, 0x81, 0x60, 0, 0x10, 0x27, 0, 0], false),
        ] {
            let mut node = Node::new(1, true);
            node.request(&sent);
            assert_eq!(node.restarted, lost, "{sent:x?}");
        }
        let mut node = Node::new(1, true);
        node.request(&[0x2F, 0x60, 0x60, 0, HOMING, 0, 0, 0]);
        node.restarted = false;
        node.request(&[0x2F, 0x60, 0x60, 0, 8, 0, 0, 0]); // the homing is over
        assert!(node.restarted);
    }

    #[test]
    fn a_homing_lasts_until_its_statusword_says_attained_and_no_error() {
        let mut node = Node::new(1, true);
        node.take_statusword(0x1237); // the bit means something else in another mode
        node.request(&[0x2F, 0x60, 0x60, 0, HOMING, 0, 0, 0]);
        for (word, searching, restarted) in [
            (0x1637, false, true), // not yet in that mode
            (0x0237, true, false),
            (0x2237, true, false), // failed
            (0x3237, true, false),
            (0x0237, true, false),
            (0x1637, false, true),
            (0x1237, false, false),
            (0x0237, true, false), // again
            (0x1637, false, true),
        ] {
            node.take_statusword(word);
            assert_eq!((node.searching, node.restarted), (searching, restarted), "{word:#x}");
            node.restarted = false;
        }
        node.take_statusword(0x0237);
        node.heartbeat(0, nobody());
        assert!(!node.searching);
    }
}
