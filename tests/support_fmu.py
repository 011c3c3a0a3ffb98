"""An FMU built from a few lines of C: a lag, for FMI 2 and 3."""

import re
import subprocess
import zipfile
from pathlib import Path

from fmpy import fmi2, fmi3

# x' = (u - x) / T, exact under a held u; T = 0.1 s. A negative u of -999 is a crash.
LAW = """
#include <math.h>
#include <stdlib.h>
#include <string.h>
static double x, u;
static void begin(void) { x = START; u = 0.0; }
static void advance(double h) { if (u == -999.0) abort(); x = u + (x - u) * exp(-h / 0.1); }
#define OK(name) int name() { return 0; }
"""
FMI2 = """
void *fmi2Instantiate() { begin(); return &x; }
int fmi2Reset(void *c) { begin(); return 0; }
int fmi2SetReal(void *c, const unsigned *r, size_t n, const double *v) { u = v[0]; return 0; }
int fmi2GetReal(void *c, const unsigned *r, size_t n, double *v) { v[0] = x; return 0; }
int fmi2DoStep(void *c, double t, double h, int p) { advance(h); return h > 5.0 ? 3 : 0; }
"""
FMI3 = """
void *fmi3InstantiateCoSimulation() { begin(); return &x; }
int fmi3Reset(void *c) { begin(); return 0; }
int fmi3SetFloat64(void *c, const unsigned *r, size_t n, const double *v, size_t m)
{ u = v[0]; return 0; }
int fmi3GetFloat64(void *c, const unsigned *r, size_t n, double *v, size_t m)
{ v[0] = x; return 0; }
int fmi3DoStep(void *c, double t, double h, int p, char *e, char *d, char *l, double *last)
{ advance(h); *e = *d = *l = 0; *last = t + h; return 0; }
"""
ABOUT2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="lag" guid="{{1}}" generationTool="{tool}">
<CoSimulation modelIdentifier="lag" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="F" valueReference="1" causality="output"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
</fmiModelDescription>"""
ABOUT3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="lag" instantiationToken="1"
 generationTool="{tool}">
<CoSimulation modelIdentifier="lag" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables>
<Float64 name="time" valueReference="2" causality="independent"/>
<Float64 name="u" valueReference="0" causality="input" start="0"/>
<Float64 name="F" valueReference="1" causality="output"/>
</ModelVariables>
<ModelStructure><Output valueReference="1"/></ModelStructure>
</fmiModelDescription>"""
OF_VERSION = {2: (FMI2, ABOUT2, "linux64"), 3: (FMI3, ABOUT3, "x86_64-linux")}


def build(folder, version=2, tool="cc", platform=None, start="2.0"):
    source, about, own = OF_VERSION[version]
    code, library = folder / "lag.c", folder / "lag.so"
    module = fmi2 if version == 2 else fmi3
    # FMPy wants every function of the standard; those that are of no use here return 0.
    names = set(re.findall(rf"fmi{version}[A-Z]\w+", Path(module.__file__).read_text()))
    rest = " ".join(f"OK({name})" for name in sorted(names) if name not in source)
    code.write_text(LAW.replace("START", start) + source + rest)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, code, "-lm", "-w"], check=True)
    path = folder / f"lag{version}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", about.format(tool=tool))
        archive.write(library, f"binaries/{platform or own}/lag.so")
    return path
