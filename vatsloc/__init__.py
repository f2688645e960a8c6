"""Finding a lung nodule in the collapsed lung: formats, workflow, evaluation, report and command line."""
