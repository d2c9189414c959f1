"""Devices: what they are called, what they can do, and how they fail. What is where:

the contract    `types`, `protocols`, `errors`, `check` (a harmless look at real hardware)
silence         `guard_rule` (pure), `guard`, `interlock`, `isolated`, `isolated_link`,
                `isolated_process`
sound cards     `soundcard`, `audio_settings`, `audio_devices`, `audio_callback`, `audio_blocks`,
                `ring`, `oscillator`, `counter`, `clockcheck`
instruments     `visa_link`, `visa_generator`, `visa_scope`, `scpi_dialects`, `serialport`,
                `serial_devices`, `microcontroller`, `packets`, `ni`, `ni_library`
rigs of them    `factory`, `discovery`, `composed`, `operated`, `wrapped`, `stepped_output`,
                `blocks`, `clock`, `elsewhere`
"""
