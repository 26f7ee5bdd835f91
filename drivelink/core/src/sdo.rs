//! Follows the SDO transfers of one node in another master's traffic (CiA 301, 7.2.4.3).

/// Index and subindex.
pub type Address = (u16, u8);

const DOWNLOAD_SEGMENT: u8 = 0; // commands of the client
const DOWNLOAD: u8 = 1;
const UPLOAD: u8 = 2;
const UPLOAD_SEGMENT: u8 = 3;
const ABORT: u8 = 4;
const BLOCK_DOWNLOAD: u8 = 6;
const SEGMENT_SENT: u8 = 0; // commands of the server; it aborts with 4
const SEGMENT_TAKEN: u8 = 1;
const UPLOADED: u8 = 2;
const DOWNLOADED: u8 = 3;
const TOGGLE: u8 = 0x10;
/// No object of interest is longer.
pub const MOST: usize = 8;

/// What was transferred so far, of which the first bytes are kept.
#[derive(Clone, Copy, Default)]
pub struct Value {
    bytes: [u8; 2 * MOST],
    len: usize,
}

impl Value {
    fn add(&mut self, data: &[u8]) {
        if self.len <= MOST {
            self.bytes[self.len..self.len + data.len()].copy_from_slice(data);
            self.len += data.len();
        }
    }

    /// Its bytes; `None`: they are too many.
    pub fn whole(&self) -> Option<&[u8]> {
        (self.len <= MOST).then(|| &self.bytes[..self.len])
    }
}

struct Transfer {
    address: Address,
    writing: bool,
    asked_s: f64,    // time of the present request
    due: Option<u8>, // the command that answers it; None: it has been answered
    segmented: bool,
    value: Value,    // to or from the node
    answer: [u8; 8], // the last one accepted
    toggle: u8,      // of the present segment
    last: bool,      // the present segment is the last one
    ended: bool,     // complete, aborted or disputed
}

/// What an answer of the node has ended.
pub enum Ended {
    /// A transfer with two different answers.
    Disputed(Address),
    /// A transfer, and whether it has written the object.
    Complete(Address, Value, bool),
}

/// The channel of one node.
pub struct Transfers {
    timeout_s: f64,
    transfer: Option<Transfer>,
    blocks: bool,       // a block transfer
    block_s: f64,       // time of the last segment of a block download
    last_segment: bool, // of it
    /// Answers that belong to no request.
    pub unasked: u64,
}

impl Transfers {
    /// Of a node whose answers come within a time.
    pub fn new(timeout_s: f64) -> Transfers {
        let block_s = f64::NEG_INFINITY;
        Transfers { timeout_s, transfer: None, blocks: false, block_s, last_segment: false, unasked: 0 }
    }

    /// The node has restarted.
    pub fn forget(&mut self) {
        self.transfer = None;
    }

    /// The object being written, not yet confirmed.
    pub fn pending(&self) -> Option<Address> {
        self.transfer.as_ref().filter(|one| one.writing && !one.ended).map(|one| one.address)
    }

    /// A frame of the master; returns objects whose value is not known any more.
    pub fn request(&mut self, data: &[u8], now_s: f64) -> [Option<Address>; 2] {
        let Some(data) = padded(data) else { return [None; 2] };
        if self.goes_on(data[0], now_s) {
            return [None; 2];
        }
        let command = data[0] >> 5;
        self.blocks = command > ABORT;
        let mut lost = [None; 2];
        if command == BLOCK_DOWNLOAD {
            (self.block_s, self.last_segment) = (now_s, false);
            lost[0] = Some(address(&data));
        }
        if let Some(one) = self.transfer.as_mut().filter(|one| one.may_go_on(data[0])) {
            (one.asked_s, one.toggle) = (now_s, data[0] & TOGGLE);
            one.due = Some(if one.writing { SEGMENT_TAKEN } else { SEGMENT_SENT });
            if one.writing {
                one.add_segment(&data);
            }
            return lost;
        }
        lost[1] = self.pending();
        // Else an abort, a block transfer, or out of order.
        self.transfer = matches!(command, DOWNLOAD | UPLOAD).then(|| Transfer::begun(&data, now_s));
        lost
    }

    /// A frame of the node.
    pub fn response(&mut self, data: &[u8], now_s: f64) -> Option<Ended> {
        let data = padded(data)?;
        let command = data[0] >> 5;
        if command == ABORT {
            self.block_s = f64::NEG_INFINITY; // the node refuses a block download, or gives it up
        }
        if self.blocks {
            return None;
        }
        let timeout_s = self.timeout_s;
        let asked = |one: &&mut Transfer| now_s - one.asked_s <= timeout_s && one.is_named(&data);
        let Some(one) = self.transfer.as_mut().filter(asked) else {
            self.unasked += 1;
            return None;
        };
        match one.due {
            None if data == one.answer => None,
            None => {
                self.unasked += 1;
                one.ended = true;
                Some(Ended::Disputed(one.address))
            }
            Some(due) if command == due || command == ABORT => one.accept(data),
            Some(_) => {
                self.unasked += 1;
                None
            }
        }
    }

    /// Whether the master's frame belongs to a block download: its segments look like requests.
    fn goes_on(&mut self, first: u8, now_s: f64) -> bool {
        if now_s - self.block_s > self.timeout_s {
            return false;
        }
        let ended = first == ABORT << 5 || (self.last_segment && first & 0xE3 == 0xC1);
        self.block_s = if ended { f64::NEG_INFINITY } else { now_s };
        self.last_segment = first & 0x80 != 0;
        true
    }
}

impl Transfer {
    fn begun(data: &[u8; 8], asked_s: f64) -> Transfer {
        let writing = data[0] >> 5 == DOWNLOAD;
        let segmented = writing && data[0] & 0x02 == 0;
        let mut value = Value::default();
        if writing && !segmented {
            value.add(expedited(data));
        }
        let due = Some(if writing { DOWNLOADED } else { UPLOADED });
        let (answer, toggle, last, ended) = ([0; 8], TOGGLE, false, false);
        Transfer {
            address: address(data),
            writing,
            asked_s,
            due,
            segmented,
            value,
            answer,
            toggle,
            last,
            ended,
        }
    }

    /// Whether a request is the next segment: answered before, and with the other toggle bit.
    fn may_go_on(&self, first: u8) -> bool {
        let wanted = if self.writing { DOWNLOAD_SEGMENT } else { UPLOAD_SEGMENT };
        let ready = self.segmented && self.due.is_none() && !self.ended;
        ready && first >> 5 == wanted && first & TOGGLE != self.toggle
    }

    /// Whether an answer names the object, or the segment, of the present request.
    fn is_named(&self, data: &[u8; 8]) -> bool {
        match data[0] >> 5 {
            SEGMENT_SENT | SEGMENT_TAKEN => self.segmented && data[0] & TOGGLE == self.toggle,
            _ => address(data) == self.address,
        }
    }

    /// The answer that is due.
    fn accept(&mut self, data: [u8; 8]) -> Option<Ended> {
        (self.due, self.answer) = (None, data);
        match data[0] >> 5 {
            ABORT => self.ended = true,
            UPLOADED => {
                self.segmented = data[0] & 0x02 == 0;
                if !self.segmented {
                    self.value.add(expedited(&data));
                }
            }
            SEGMENT_SENT => self.add_segment(&data),
            _ => (),
        }
        let complete = !self.ended && (self.last || !self.segmented);
        self.ended |= complete;
        complete.then_some(Ended::Complete(self.address, self.value, self.writing))
    }

    fn add_segment(&mut self, data: &[u8; 8]) {
        self.value.add(&data[1..8 - usize::from(data[0] >> 1 & 7)]);
        self.last = data[0] & 0x01 != 0;
    }
}

/// The eight bytes of a frame, of which some nodes take fewer; `None`: it is none of SDO.
fn padded(data: &[u8]) -> Option<[u8; 8]> {
    let mut whole = [0; 8];
    whole.get_mut(..data.len())?.copy_from_slice(data);
    (!data.is_empty()).then_some(whole)
}

fn address(data: &[u8; 8]) -> Address {
    (u16::from_le_bytes([data[1], data[2]]), data[3])
}

fn expedited(data: &[u8; 8]) -> &[u8] {
    let unused = if data[0] & 0x01 != 0 { data[0] >> 2 & 3 } else { 0 };
    &data[4..8 - usize::from(unused)]
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAP: Address = (0x1A00, 0);

    fn ends(made: &mut Transfers, request: &[u8], answer: &[u8]) -> Option<u64> {
        made.request(request, 0.0);
        match made.response(answer, 0.01) {
            Some(Ended::Complete(MAP, value, _)) => value.whole()?.first().map(|byte| u64::from(*byte)),
            _ => None,
        }
    }

    #[test]
    fn what_the_node_confirms_is_written_and_what_it_answers_is_read() {
        let mut made = Transfers::new(0.1);
        assert_eq!(ends(&mut made, &[0x2F, 0, 0x1A, 0, 2, 0, 0, 0], &[0x60, 0, 0x1A, 0]), Some(2));
        assert_eq!(ends(&mut made, &[0x40, 0, 0x1A, 0], &[0x4F, 0, 0x1A, 0, 3, 0, 0, 0]), Some(3));
        assert_eq!(ends(&mut made, &[0x40, 0, 0x1A, 0], &[0x4F, 0, 0x1A, 1, 3, 0, 0, 0]), None);
        assert_eq!(made.unasked, 1);
    }

    #[test]
    fn what_is_given_up_or_written_in_blocks_is_lost_until_the_node_refuses_it() {
        let mut made = Transfers::new(0.1);
        made.request(&[0x2F, 0, 0x1A, 0, 2, 0, 0, 0], 0.0);
        assert_eq!(made.pending(), Some(MAP));
        assert_eq!(made.request(&[0x80, 0, 0, 0], 0.0), [None, Some(MAP)]);
        let block = [0xC2, 0, 0x1A, 0, 8, 0, 0, 0];
        assert_eq!(made.request(&block, 0.0), [Some(MAP), None]);
        assert_eq!(made.request(&block, 0.0), [None, None]); // a segment of it
        made.response(&[0x80, 0, 0x1A, 0], 0.0);
        assert_eq!(made.request(&block, 0.0), [Some(MAP), None]);
    }
}
