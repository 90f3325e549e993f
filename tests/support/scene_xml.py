"""Parts of scene files."""

#: A box of fog whose extinction is in the file ``$density``.
FOG_IN_A_BOX = """<shape type="cube" id="box">
        <bsdf type="null"/>
        <medium name="interior" type="heterogeneous" id="fog">
            <volume name="sigma_t" type="gridvolume">
                <string name="filename" value="$density"/>
                <transform name="to_world">
                    <translate value="-.5, -.5, -.5"/> <scale value="2"/>
                </transform>
            </volume>
            <float name="albedo" value="0.8"/>
        </medium>
    </shape>"""
