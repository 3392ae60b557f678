//! What the codes of a controller's refusals mean.

/// What an interpreter message means, in words; a code that is not known is said to be so.
///
/// ```
/// assert_eq!(samsod_robot::motoman::meaning(2070), "servo power is off");
/// assert_eq!(samsod_robot::motoman::meaning(9999), "not a known interpreter message");
/// ```
pub fn meaning(code: u32) -> &'static str {
    match code {
        1010 => "the command is not known",
        1011 => "wrong number of operands",
        1012 => "an operand is out of range",
        1013 => "wrong length of the operands",
        2010 => "the manipulator is running",
        2020 => "on hold by the pendant",
        2030 => "on hold by the panel",
        2040 => "on hold by an external signal",
        2050 => "on hold by command",
        2060 => "an alarm or error stands",
        2070 => "servo power is off",
        2080 => "wrong mode",
        2090 => "another uses the file",
        2100 => "command remote is not set",
        2110 | 2120 => "the data cannot be accessed",
        2130 => "data is being edited",
        3010 => "servo power must be turned on",
        3040 => "the home position must be confirmed",
        3050 => "the position must be confirmed",
        3220 => "the panel is locked",
        3230 => "the panel is locked by a signal",
        3350 => "the user frame is not taught",
        3450 => "servo power cannot be turned on",
        4040 => "no such job",
        4120..=4140 => "position data",
        5110..=5200 => "syntax, format or range of the data",
        _ => "not a known interpreter message",
    }
}
