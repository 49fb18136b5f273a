SECTIONS=Section=render=write_report=None
