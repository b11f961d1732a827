//! The commands of the README, so that what runs in CI is what a reader copies.

use anyhow::{Result, bail};

/// The lines of the fenced block that directly follows the line `<!-- marker -->`, each ending in a
/// newline.
///
/// # Errors
/// When the marker is missing or stands more than once, or no complete fenced block follows.
pub fn block_after(text: &str, marker: &str) -> Result<String> {
    let wanted = format!("<!-- {marker} -->");
    let mut places = text.lines().enumerate().filter(|(_, line)| line.trim() == wanted);
    let Some((at, _)) = places.next() else {
        bail!("README.md has no line `{wanted}`; put it before the fenced block with the command");
    };
    if let Some((again, _)) = places.next() {
        bail!("README.md has `{wanted}` on lines {} and {}; keep one", at + 1, again + 1);
    }
    let mut rest = text.lines().skip(at + 1).skip_while(|line| line.trim().is_empty());
    if !rest.next().is_some_and(|line| line.trim_start().starts_with("```")) {
        bail!("README.md: no fenced block follows `{wanted}` on line {}", at + 1);
    }
    let mut block = String::new();
    for line in rest {
        if line.trim_start().starts_with("```") {
            if block.trim().is_empty() {
                bail!("README.md: the block behind `{wanted}` is empty");
            }
            return Ok(block);
        }
        block.push_str(line);
        block.push('\n');
    }
    bail!("README.md: the block behind `{wanted}` on line {} is never closed", at + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_block_behind_the_marker_is_found() {
        let text = "# x\n```sh\nother\n```\n<!-- test command -->\n\n```sh\ncargo test\ncargo doc\n```\n```\nno\n```\n";
        assert_eq!(block_after(text, "test command").unwrap(), "cargo test\ncargo doc\n");
    }

    #[test]
    fn what_is_missing_is_said() {
        let error = |text: &str| block_after(text, "m").unwrap_err().to_string();
        assert!(error("").contains("has no line `<!-- m -->`"));
        assert!(error("<!-- m -->\ntext\n```\na\n```").contains("no fenced block follows"));
        assert!(error("<!-- m -->\n```\na\n").contains("never closed"));
        assert!(error("<!-- m -->\n```\n```\n").contains("is empty"));
        assert!(error("<!-- m -->\n```\na\n```\n<!-- m -->\n").contains("lines 1 and 5"));
    }
}
