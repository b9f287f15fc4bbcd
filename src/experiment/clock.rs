//! What training takes. A run trains in one thread, whose processor time other work on the machine does not lengthen: it can be
//! compared where wall-clock time cannot.

use crate::learn::device::Device;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// Which time is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Clock {
    /// Processor time of this thread.
    Processor,
    /// Wall-clock time.
    Wall,
}

impl Clock {
    /// Wall-clock time where a graphics card works, and where the system does not tell a thread's time.
    pub fn of(device: Device) -> Clock {
        if cfg!(unix) && device == Device::Cpu { Clock::Processor } else { Clock::Wall }
    }

    /// Time since some moment of the past; of the processor, that of the thread that asks.
    pub fn now(self) -> Duration {
        #[cfg(unix)]
        {
            use rustix::time::{ClockId, clock_gettime};
            let time = clock_gettime(match self {
                Clock::Processor => ClockId::ThreadCPUTime,
                Clock::Wall => ClockId::Monotonic,
            });
            Duration::new(
                time.tv_sec.unsigned_abs(),
                u32::try_from(time.tv_nsec).unwrap_or_default(),
            )
        }
        #[cfg(not(unix))]
        {
            static START: std::sync::LazyLock<std::time::Instant> =
                std::sync::LazyLock::new(std::time::Instant::now);
            START.elapsed()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Clock;
    use std::time::Duration;

    #[test]
    #[cfg(unix)]
    fn a_sleeping_thread_takes_no_processor_time() {
        let both = || [Clock::Processor, Clock::Wall].map(Clock::now);
        let before = both();
        std::thread::sleep(Duration::from_millis(200));
        let after = both();
        assert!(after[0] - before[0] < Duration::from_millis(100));
        assert!(after[1] - before[1] >= Duration::from_millis(200));
        while Clock::Processor.now() - after[0] < Duration::from_millis(5) {}
    }
}
