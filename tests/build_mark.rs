//! The mark by which a program recognises its checkpoints covers code, not comments, blank lines or unit tests.

#[path = "../build.rs"]
#[expect(dead_code, reason = "the rest of the build script runs in a build only")]
mod build;

use build::code;

const SOURCE: &str = "\
//! A module.

use std::fmt;

/// A function.
fn half(x: f64) -> f64 {
    // Exact in binary.
    0.5 * x // a comment after code counts
}
";

const CODE: &str = "\
use std::fmt;
fn half(x: f64) -> f64 {
    0.5 * x // a comment after code counts
}";

const TESTS: &str = "\
#[cfg(test)]
mod tests {
    #[test]
    fn a_half() {
        assert_eq!(super::half(1.0), 0.5);
    }
}
";

#[test]
fn comments_and_blank_lines_do_not_count() {
    assert_eq!(code(SOURCE), CODE);
    assert_eq!(code(&SOURCE.replace("A function", "Another text")), CODE);
    assert_eq!(code(&SOURCE.replace('\n', "\r\n")), CODE);
    assert_eq!(code(""), "");
}

#[test]
fn a_change_of_code_counts() {
    assert_ne!(code(&SOURCE.replace("0.5", "0.25")), CODE);
    // A comment in the middle of a line is not looked for.
    assert_ne!(code(&SOURCE.replace("counts", "matters")), CODE);
}

#[test]
fn unit_tests_at_the_end_do_not_count() {
    assert_eq!(code(&format!("{SOURCE}\n{TESTS}")), CODE);
    assert_eq!(code(&format!("{SOURCE}\n{TESTS}\n// The end.\n")), CODE);
}

/// What comes after a test module is code; a file of tests is only declared.
#[test]
fn code_after_a_test_module_counts() {
    let code_after = format!("{TESTS}\n{SOURCE}");
    assert!(code(&code_after).ends_with(CODE));
    let declared = format!("#[cfg(test)]\nmod tests;\n{SOURCE}");
    assert!(code(&declared).ends_with(CODE));
    let helper = "#[cfg(test)]\nfn helper() {\n}\n";
    assert_eq!(code(&format!("{SOURCE}{helper}{TESTS}")), format!("{CODE}\n{}", helper.trim_end()));
}
