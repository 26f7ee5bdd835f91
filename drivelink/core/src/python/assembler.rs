//! `Assembler` and the counters of its nodes.

use std::collections::BTreeMap;
use std::sync::Mutex;

use estimator_core::python::sample_object;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};

use super::lock;
use super::values::drive_error;
use crate::assembler;
use crate::cross_check::{CrossCheck, Verdict};
use crate::layout::Node;
use crate::node::Counters;

#[pymethods]
impl Counters {
    #[new]
    fn new() -> Counters {
        Counters::default()
    }

    fn as_dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let found = PyDict::new(py);
        for (name, count) in [
            ("received", self.received),
            ("missing", self.missing),
            ("late", self.late),
            ("duplicate", self.duplicate),
            ("conflicting", self.conflicting),
            ("wrong_length", self.wrong_length),
            ("ignored", self.ignored),
            ("reboots", self.reboots),
            ("emergencies", self.emergencies),
        ] {
            found.set_item(name, count)?;
        }
        Ok(found)
    }
}

/// Makes the samples of one joint from the frames of its nodes.
#[pyclass(frozen, module = "drivelink._core")]
pub(super) struct Assembler {
    pub(super) core: Mutex<assembler::Assembler>,
}

#[pymethods]
impl Assembler {
    #[new]
    #[pyo3(signature = (layouts, motors, *, active = true, hold_periods = 250, period_s = 0.001))]
    fn new(
        py: Python<'_>,
        layouts: Vec<Node>,
        motors: usize,
        active: bool,
        hold_periods: i64,
        period_s: f64,
    ) -> PyResult<Assembler> {
        let core = assembler::Assembler::new(&layouts, motors, active, hold_periods, period_s)
            .map_err(|message| drive_error(py, message))?;
        Ok(Assembler { core: Mutex::new(core) })
    }

    #[getter]
    fn sequence(&self) -> i64 {
        lock(&self.core).sequence
    }

    #[getter]
    fn missed(&self) -> i64 {
        lock(&self.core).missed.unwrap_or(-1)
    }

    #[getter]
    fn flags(&self) -> u32 {
        lock(&self.core).flags
    }

    #[getter]
    fn cob_ids<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let cob_ids: Vec<u32> = lock(&self.core).cob_ids().collect();
        PyTuple::new(py, cob_ids)
    }

    #[getter]
    fn counters(&self) -> BTreeMap<u32, Counters> {
        lock(&self.core).nodes().iter().map(|node| (node.node_id, node.counters)).collect()
    }

    #[getter]
    fn faults(&self) -> BTreeMap<u32, u16> {
        let core = lock(&self.core);
        let faulted = core.nodes().iter().filter(|node| node.faulted || node.emergency != 0);
        faulted.map(|node| (node.node_id, node.emergency)).collect()
    }

    #[getter]
    fn statuswords(&self) -> BTreeMap<u32, i64> {
        let core = lock(&self.core);
        core.nodes().iter().filter_map(|node| Some((node.node_id, node.statusword?))).collect()
    }

    #[getter]
    fn untrusted<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let core = lock(&self.core);
        let nodes: Vec<u32> = core.nodes().iter().filter(|n| !n.trusted).map(|n| n.node_id).collect();
        PyTuple::new(py, nodes)
    }

    #[getter]
    fn checks(&self) -> Vec<(usize, &'static str, &'static str, f64, f64)> {
        let fields = |check: &CrossCheck| {
            let verdict = match check.verdict() {
                Verdict::Untested => "untested",
                Verdict::Agrees => "agrees",
                Verdict::Contradicts => "contradicts",
            };
            let (scale, std) = check.scale();
            (check.motor + 1, check.kind.name(), verdict, scale, std)
        };
        lock(&self.core).checks().iter().map(fields).collect()
    }

    #[getter]
    fn has_link(&self) -> bool {
        lock(&self.core).has_link()
    }

    #[getter]
    fn complete(&self) -> bool {
        lock(&self.core).complete()
    }

    #[pyo3(signature = (cob_id, data, jump = 1))]
    fn feed<'py>(
        &self,
        py: Python<'py>,
        cob_id: u32,
        data: &[u8],
        jump: i64,
    ) -> PyResult<Option<Bound<'py, PyAny>>> {
        let (sample, motors) = {
            let mut core = lock(&self.core);
            (core.feed(cob_id, data, jump), core.motors())
        };
        sample.map(|sample| sample_object(py, &sample, motors)).transpose()
    }

    fn supervise(&self) {
        lock(&self.core).supervise();
    }

    fn distrust(&self, node_id: u32) {
        lock(&self.core).distrust(node_id);
    }

    fn trust(&self, node_id: u32) {
        lock(&self.core).trust(node_id);
    }

    fn contradict(&self, node_id: u32, contradicted: bool) {
        lock(&self.core).contradict(node_id, contradicted);
    }

    fn relayout(&self, py: Python<'_>, layout: Node) -> PyResult<()> {
        let changed = lock(&self.core).relayout(&layout);
        changed.map_err(|message| drive_error(py, message))
    }
}
