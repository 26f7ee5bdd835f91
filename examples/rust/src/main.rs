//! Print a joint's estimates, those missing counted: `cargo run -- elbow [tcp/127.0.0.1:7447 [COUNT]]`.

use std::io::{self, Write};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use drivelink_wire::Estimate;
use zenoh::handlers::RingChannel;
use zenoh::{Config, Wait};

type Failure = Box<dyn std::error::Error + Send + Sync>;

fn session(endpoint: &str) -> Result<zenoh::Session, Failure> {
    let mut config = Config::default();
    config.insert_json5("mode", "\"client\"")?;
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]"))?;
    config.insert_json5("scouting/multicast/enabled", "false")?;
    zenoh::open(config).wait()
}

fn main() -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1);
    let joint = arguments.next().unwrap_or("elbow".into());
    let endpoint = arguments.next().unwrap_or("tcp/127.0.0.1:7447".into());
    let count: usize = arguments.next().map_or(Ok(usize::MAX), |n| n.parse())?;

    let session = session(&endpoint)?;
    let subscriber = session
        .declare_subscriber(format!("drivelink/{joint}/estimate"))
        .with(RingChannel::new(1024))
        .wait()?;

    let mut last: Option<u64> = None;
    let mut missing = 0;
    for _ in 0..count {
        let sample = loop {
            match subscriber.recv_timeout(Duration::from_secs(3))? {
                Some(sample) => break sample,
                None => eprintln!("no estimate of {joint} at {endpoint}: `drivelink list` names the joints"),
            }
        };
        let decoded = Estimate::decode(sample.payload()).inspect_err(|error| eprintln!("not used: {error}"));
        let Ok(estimate) = decoded else { continue };
        missing += last.map_or(0, |last| estimate.sequence.saturating_sub(last + 1));
        last = Some(estimate.sequence);
        let now_ns = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as i128;
        // Two digits of the uncertainty, and the value as far.
        let places = (1.0 - estimate.stiffness_std_nm_rad.log10().floor()).clamp(0.0, 9.0) as usize;
        let written = writeln!(
            io::stdout(),
            "{} {:.3} N·m, {:.places$} ± {:.places$} N·m/rad, valid {}, observable {}, usable {}, {} µs after its SYNC, {} missing",
            estimate.sequence,
            estimate.flexibility_torque_nm,
            estimate.stiffness_nm_rad,
            estimate.stiffness_std_nm_rad,
            estimate.valid(),
            estimate.observable(),
            estimate.usable(),
            (now_ns - i128::from(estimate.stamp_ns)) / 1000,
            missing
        );
        match written {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => break, // `| head`
            other => other?,
        }
    }
    Ok(())
}
