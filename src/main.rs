//! The `windhover` program: parse the command line, run it, exit with its code.

fn main() -> std::process::ExitCode {
    windhover::cli::main()
}
