//! The device of the networks.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The devices, in words.
pub const DEVICES: &str = "\"cpu\", \"cuda\" or \"cuda:N\"";

/// The device of the networks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// A CUDA device by its number; needs the feature `torch`.
    Cuda(usize),
}

/// A device that this program cannot use here.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// The program was built without the feature `torch`.
    #[error(
        "device {0} needs a program built with the feature `torch`; run `cargo xtask torch build \
         --release`, or use --device cpu"
    )]
    WithoutTorch(Device),
    /// libtorch does not see the device.
    #[error(
        "device {device} is not available: libtorch sees {seen} CUDA devices; use --device cpu, or \
         build against a libtorch with CUDA (set LIBTORCH to its folder) on a machine that has the \
         device"
    )]
    Absent {
        /// The device.
        device: Device,
        /// How many CUDA devices there are.
        seen: i64,
    },
}

impl Device {
    /// Checks that networks can be put on this device.
    ///
    /// # Errors
    /// If this program or this machine does not have it.
    pub fn require(self) -> Result<(), DeviceError> {
        match self {
            Device::Cpu => Ok(()),
            #[cfg(not(feature = "torch"))]
            Device::Cuda(_) => Err(DeviceError::WithoutTorch(self)),
            #[cfg(feature = "torch")]
            Device::Cuda(number) => match tch::Cuda::device_count() {
                seen if (number as i64) < seen => Ok(()),
                seen => Err(DeviceError::Absent { device: self, seen }),
            },
        }
    }
}

#[cfg(feature = "torch")]
impl From<Device> for tch::Device {
    fn from(device: Device) -> Self {
        match device {
            Device::Cpu => tch::Device::Cpu,
            Device::Cuda(number) => tch::Device::Cuda(number),
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Device::Cpu => f.write_str("cpu"),
            Device::Cuda(0) => f.write_str("cuda"),
            Device::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = match text {
            "cpu" => return Ok(Device::Cpu),
            "cuda" => Some(0),
            _ => text.strip_prefix("cuda:").and_then(|number| number.parse().ok()),
        };
        number.map(Device::Cuda).ok_or_else(|| format!("device {text:?} is not {DEVICES}"))
    }
}

impl From<Device> for String {
    fn from(device: Device) -> Self {
        device.to_string()
    }
}

impl TryFrom<String> for Device {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}
