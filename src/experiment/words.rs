//! Numbers in words, for messages and tables.

/// A number of things: `1 run`, `2,000 runs`, `3 trajectories`.
pub fn counted(number: u64, thing: &str) -> String {
    let ending = match (number, thing.strip_suffix('y')) {
        (1, _) => thing.to_owned(),
        (_, Some(stem)) => format!("{stem}ies"),
        (_, None) => format!("{thing}s"),
    };
    format!("{} {ending}", thousands(number))
}

/// A whole number with separators: 100,000.
pub fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
