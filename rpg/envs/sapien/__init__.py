"""Tasks on SAPIEN: block pushing, the two-door cabinet, and any ManiSkill task.

Nothing heavy is imported here; SAPIEN and ManiSkill are loaded by the module of a task, when it is made.
"""
