% Octave has no import of Java classes: the sender needs none but DataOutputStream.
function import (varargin)
end
