//! The nodes of a joint: which frames carry what, and whose are believed.

use estimator_core::sample::MOTORS;

use super::status::{CONTRADICTED, DRIVE_FAULT};
use super::{Assembler, COB_IDS, Receiver, SYNC_COB_ID, VALUES};
use crate::frames::TpdoDecoder;
use crate::layout::{self, Signal};
use crate::node::Node;

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
            late_s: 0.0,
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

    /// Identifiers that concern this joint, SYNC aside.
    pub fn cob_ids(&self) -> impl Iterator<Item = u32> + '_ {
        (0u32..).zip(&self.receivers).filter_map(|(cob_id, receiver)| {
            (*receiver != Receiver::Nobody && *receiver != Receiver::Sync).then_some(cob_id)
        })
    }

    /// Whether any frame carries the link position.
    #[must_use]
    pub fn has_link(&self) -> bool {
        self.carries(3 * self.motors)
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
            if tpdo.objects.iter().any(|mapped| mapped.signal != Signal::Other && mapped.bits > 64) {
                return Err(format!("0x{:03X}: expected objects of at most 64 bits", tpdo.cob_id));
            }
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

    pub(super) fn carries(&self, target: usize) -> bool {
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

    pub(super) fn node_and_decoders(
        &mut self,
        node: usize,
    ) -> (&mut Node, impl Iterator<Item = &mut TpdoDecoder>) {
        (&mut self.nodes[node], self.decoders.iter_mut().filter(move |decoder| decoder.node == node))
    }

    pub(super) fn note_news(&mut self) {
        self.faulted = 0;
        for node in &mut self.nodes {
            if node.faulted || node.emergency != 0 {
                self.faulted = DRIVE_FAULT;
            }
            self.restart |= std::mem::replace(&mut node.restarted, false);
        }
    }
}
